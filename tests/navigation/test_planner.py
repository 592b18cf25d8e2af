from vd4rl_pomdp.envs.maze import MazeEnv
from vd4rl_pomdp.navigation.planner import Planner


def test_the_planner_reaches_goals_everywhere():
    env = MazeEnv("no_curtain", 5, pixels=False)
    planner = Planner(env)
    _, info = env.reset(seed=0)
    reached, places = 0, []
    for _ in range(600):
        _, reward, _, _, info = env.step(planner.act(info["state"], info["goal"]))
        reached += int(reward)
        places.append(info["state"][:2])
    assert reached > 20
    cells = {tuple(env.maze.cell_xy_to_rowcol(place)) for place in places}
    assert len(cells) == 7, "all cells of the U were visited"
