from vd4rl_pomdp.envs.mazes import MAZES
from vd4rl_pomdp.studies.navigation.collect import SAMPLES, sample_observations


def test_sample_observations_are_of_different_moments_and_mazes():
    samples = sample_observations()
    assert list(samples) == [*MAZES, "three_curtains, grey50", "three_curtains, exogenous textures"]
    assert [len(pictures) for pictures in samples.values()] == [SAMPLES] * 11
    assert all(len({picture.tobytes() for picture in pictures}) > 1 for pictures in samples.values())
    assert len({pictures.tobytes() for pictures in samples.values()}) == 11
