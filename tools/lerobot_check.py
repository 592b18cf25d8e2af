"""Check `data import lerobot` and `data export lerobot` against LeRobot itself.

    python -m venv WORK/venv && WORK/venv/bin/pip install lerobot==0.4.4      # 5 GB; torchcodec needs Debian's
    python tools/lerobot_check.py WORK                                        # libavdevice59, libavfilter8 and the like

An exported dataset is loaded by `LeRobotDataset`, with both of its video decoders, and compared value by value; LeRobot
also deletes an episode of it. A dataset recorded by `LeRobotDataset` is imported and compared. The tests use only
pyarrow and av, since LeRobot requires other versions of torch. WORK must contain only `venv`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path

import numpy as np

from vd4rl_pomdp.data.format import read_frames, read_rows, write_shard
from vd4rl_pomdp.data.transfer import export_set, import_set

STEPS = (30, 45, 12)
"""Actions per episode."""

THEIRS = """
import json, sys
from pathlib import Path
import numpy as np
import lerobot
from lerobot.datasets.dataset_tools import delete_episodes
from lerobot.datasets.lerobot_dataset import LeRobotDataset

work = Path(sys.argv[1])
given = np.load(work / "given.npz")
report = {"lerobot": lerobot.__version__}
for name in ("lerobot", "lerobot_video"):
    for backend in ("torchcodec", "pyav"):
        data = LeRobotDataset("a/b", root=work / name, video_backend=backend, tolerance_s=1e-4)
        rows = [data[i] for i in range(len(data))]
        pixels = np.stack([np.rint(row["observation.image"].numpy() * 255) for row in rows])
        ends = np.flatnonzero(given["end"])
        for key, wanted in (("action", given["action"]), ("next.reward", given["reward"])):
            found = np.stack([row[key].numpy() for row in rows])
            after = np.setdiff1d(np.arange(len(rows)), ends)
            assert np.array_equal(found[after], wanted[after + 1].astype(np.float32)), key
        assert {row["task"] for row in rows} == {"walker_walk"}
        change = np.abs(pixels - given["observation"])
        off = f"pixels off by {change.mean():.3f}, at most {change.max():.0f}"
        report[f"{name}, read by {backend}"] = f"{len(rows)} rows, {off}"
    data = LeRobotDataset("a/b", root=work / name)
    fewer = delete_episodes(data, [1], output_dir=work / (name + "_fewer"), repo_id="a/c")
    mean = fewer.meta.stats["action"]["mean"].round(3).tolist()
    report[f"{name}, an episode deleted"] = f"{len(fewer)} rows, mean of actions {mean}"

picture = {"shape": (84, 84, 3), "names": ["height", "width", "channels"]}
kinds = {"image": {"observation.image": {"dtype": "image", **picture}}}
kinds["video"] = {f"observation.images.{side}": {"dtype": "video", **picture} for side in ("left", "right")}
for kind, cameras in kinds.items():
    features = cameras | {"action": {"dtype": "float32", "shape": (6,), "names": None}}
    features |= {"next.reward": {"dtype": "float32", "shape": (1,), "names": None}}
    features |= {"next.done": {"dtype": "bool", "shape": (1,), "names": None}}
    root, video = work / ("theirs_" + kind), kind == "video"
    data = LeRobotDataset.create("a/b", fps=30, features=features, root=root, use_videos=video)
    for i in range(len(given["end"])):
        if given["end"][i]:
            data.save_episode()
            continue
        frame = {key: given["observation"][i if "left" not in key else 0].transpose(1, 2, 0) for key in cameras}
        reward = given["reward"][i + 1 : i + 2].astype(np.float32)
        frame |= {"action": given["action"][i + 1] * 3, "next.reward": reward}
        data.add_frame(frame | {"next.done": np.array([given["end"][i + 1]]), "task": "Walk over there."})
    data.finalize()
print(json.dumps(report))
"""


def main(work: Path) -> None:
    """Export, let LeRobot read and record, import."""
    if {path.name for path in work.glob("*")} != {"venv"}:
        raise SystemExit(f"{work} must hold LeRobot's environment `venv` and nothing else")
    rng, episodes = np.random.default_rng(0), []
    for steps in STEPS:
        across, down = np.meshgrid(np.arange(84), np.arange(84))
        waves = [across * 3 + t * 5 + down * (1 + channel) for t in range(steps + 1) for channel in range(3)]
        frames = (np.abs(np.stack(waves) % 256 - 128) * 2).clip(0, 255).astype(np.uint8)
        episodes.append(
            {
                "observation": frames.reshape(-1, 3, 84, 84),
                "action": np.concatenate([np.zeros((1, 6)), rng.uniform(-1, 1, (steps, 6))]).astype(np.float32),
                "reward": np.append(0.0, rng.uniform(size=steps)),
                "discount": np.ones(steps + 1),
                "step_type": np.array([0] + [1] * (steps - 1) + [2]),
            }
        )
    rows = {key: np.concatenate([one[key] for one in episodes]) for key in episodes[0]}
    (work / "set").mkdir()
    write_shard(work / "set" / "0_a.hdf5", rows, {"task": "walker_walk", "set": "mine"})
    for name in ("lerobot", "lerobot_video"):
        export_set(name, work / "set", work / name)
    np.savez(work / "given.npz", end=rows["step_type"] == 2, **rows)
    done = subprocess.run(
        [work / "venv" / "bin" / "python", "-c", THEIRS, work], stdout=subprocess.PIPE, text=True, check=True
    )
    for name, value in json.loads(done.stdout.splitlines()[-1]).items():
        print(f"{name}: {value}")
    has_action = rows["step_type"] != 2  # LeRobot records no frame after the last action
    for kind, camera in (("image", None), ("video", "observation.images.right")):
        shards = import_set("lerobot", str(work / f"theirs_{kind}"), work / f"back_{kind}", picture=camera)
        back = read_rows(shards[0])
        change = np.abs(np.concatenate(list(read_frames(shards[0]))).astype(int) - rows["observation"][has_action])
        assert np.array_equal(back["reward"], rows["reward"][has_action].astype(np.float32)), "rewards"
        bound = np.concatenate([one["action"][1:] for one in episodes])
        low, high = bound.min(0), bound.max(0)
        scaled = (rows["action"][has_action] - low) / (high - low) * 2 - 1
        inner = back["step_type"] != 0
        assert np.allclose(back["action"][inner], scaled[inner], atol=1e-5), "actions"
        off = f"pixels off by {change.mean():.3f}, at most {change.max()}"
        print(f"LeRobot's own {kind}, imported: {has_action.sum()} rows, {off}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path, metavar="WORK")
    main(parser.parse_args().work)
