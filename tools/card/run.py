"""Train until a deadline on a machine with a GPU but no network, and pack what to keep.

    tar xf card.tar.xz                        # made by pack.py; tests, bench and the grids are beside this file
    python3 card/run.py --out home --seconds 570 tests=120 bench=180 cell.toml -- --jobs-per-gpu 5 --stack 5

Parts run in order, each until its own limit, those without one until the deadline: `tests` are those marked gpu,
`bench` is `vd4rl-pomdp bench --gpu`, anything else is a grid of `vd4rl-pomdp sweep run`, whose further flags follow
`--`. A grid's datasets are collected first on all cores, alongside the tests if there are any. At the deadline,
trainings write a checkpoint into --work: the same command on this machine resumes them.

--out holds log.txt; results/, the rows of finished runs as written by `results add`; records.tar.xz, the small files of
all runs, including metrics; and, with --bring MIB, encoders.tar.*, as many finished encoders as fit, smallest first, in
parts of 15 MiB. Another machine continues from such a folder with `--home FOLDER`: it skips encoders whose dataset has
the same content there, and policies whose rows exist. Unfinished runs start over.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tarfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
PROGRAM = [sys.executable, "-P", "-m", "vd4rl_pomdp"]
TO_END = 40.0
"""Seconds before the deadline for writing checkpoints and packing."""
TO_PACK = 15.0
VENDORS = ("/usr/share/glvnd", "/etc/glvnd", "/usr/local/nvidia/share/glvnd", "/usr/local/share/glvnd")
"""Where a driver may name its rendering library."""
PART_BYTES = 15 * 2**20
DRAWS = "from vd4rl_pomdp.data.parity import render_info; print(render_info())"


class Session:
    """One invocation: clock, log, and environment of its commands."""

    def __init__(self, out: Path, seconds: float) -> None:
        self.began = time.monotonic()
        self.seconds = seconds
        out.mkdir(parents=True, exist_ok=True)
        self._log = (out / "log.txt").open("a", buffering=1)
        paths = [str(HERE / "site"), str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]
        self.env = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONUNBUFFERED": "1"}
        self.env.setdefault("MUJOCO_GL", "egl")
        self.gpu = False
        self.processes: list[subprocess.Popen] = []

    def left(self, reserve: float = TO_END) -> float:
        """Seconds until running commands must end."""
        return self.began + self.seconds - reserve - time.monotonic()

    def say(self, line: str) -> None:
        """Log a line with a timestamp."""
        self.write(f"[{time.monotonic() - self.began:6.1f} s] {line}\n")

    def write(self, text: str) -> None:
        """Write text to the screen and the log."""
        self._log.write(text)
        with suppress(OSError):
            print(text, end="", flush=True)

    def run(self, words: list[str], seconds: float, quiet: bool = False) -> tuple[int, str]:
        """Run a command with a time limit; returns its exit code and output.

        At the limit it gets SIGTERM, so that a training writes a checkpoint, then SIGKILL.
        """
        if seconds <= 0:
            self.say(f"no time left for {shlex.join(words)}")
            return 143, ""
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "errors": "replace"}
        process = subprocess.Popen(words, env=self.env, text=True, start_new_session=True, **pipes)
        lines: list[str] = []

        def read() -> None:
            for line in process.stdout or ():
                lines.append(line)
                if not quiet:
                    self.write(line)

        self.processes.append(process)
        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.say("time is up: asked to end")
        finally:  # also if this process is terminated
            if process.poll() is None:
                process.terminate()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(min(max(5.0, self.left(TO_PACK)), TO_END))
                with suppress(ProcessLookupError):  # and its workers
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        reader.join(5)
        return process.returncode, "".join(lines)

    def describe(self) -> None:
        """Log the machine and its torch version."""
        found = "from torch import __version__, cuda"
        found += "; print(__version__, *map(cuda.get_device_name, range(cuda.device_count())))"
        code, output = self.run([sys.executable, "-c", found], 90, quiet=True)
        self.gpu = len(output.split()) > 1
        self.say(f"Python {sys.version.split()[0]}, {os.cpu_count()} cores, torch {output.strip()} ({code})")

    def find_renderer(self) -> None:
        """Choose an environment that renders a frame, with the GPU if possible: the machine's own, or with packed
        libraries."""
        files = [str(file) for folder in VENDORS for file in Path(folder).glob("egl_vendor.d/*nvidia*.json")]
        folders = filter(None, [str(HERE / "opengl"), os.environ.get("LD_LIBRARY_PATH")])
        packed = {"LD_LIBRARY_PATH": os.pathsep.join(folders)}
        vendor = {"__EGL_VENDOR_LIBRARY_FILENAMES": files[0]} if files else {}
        before, found, output = dict(self.env), None, ""
        for more in ({}, packed, vendor, packed | vendor):
            self.env = before | more
            code, output = self.run([sys.executable, "-P", "-c", DRAWS], 60, quiet=True)
            if code == 0 and (found is None or "NVIDIA" in output):
                found = more
                self.say(f"drawn by {output.strip().splitlines()[-1]} {more or ''}")
            if found is not None and ("NVIDIA" in output or not self.gpu):
                break
        self.env = before | (found or {})
        if found is None:
            self.say(f"nothing draws here: {output.strip()[-500:]}")


def collect(session: Session, sweep: list[str], until: float) -> int:
    """Collect a sweep's datasets, one after another, until a deadline; returns the exit code."""
    code, plan = session.run([*sweep, "--dry-run"], until - time.monotonic(), quiet=True)
    if code:
        session.write(plan)
        return code
    session.say(plan.strip().splitlines()[-1])
    for line in plan.splitlines():
        command = shlex.split(line, comments=True)[1:]
        if code == 0 and command[:2] == ["data", "collect"]:
            code, output = session.run([*PROGRAM, *command], until - time.monotonic(), quiet=True)
            session.say(f"{command[-1]}: {output if code else 'collected'}")
    return code


def run_tests(session: Session, seconds: float, sweeps: list[list[str]]) -> int:
    """Run the GPU tests while the grids' datasets are collected; returns the tests' exit code."""
    words = [sys.executable, "-m", "pytest", "-m", "gpu", "-v", "-ra", "--durations=0", "--durations-min=1"]
    words += ["-p", "no:cacheprovider", "--continue-on-collection-errors", "-c", str(HERE / "pyproject.toml")]
    files = [path for path in sorted((HERE / "tests").rglob("test_*.py")) if "mark.gpu" in path.read_text()]
    until = time.monotonic() + session.left()
    beside = threading.Thread(target=lambda: [collect(session, sweep, until) for sweep in sweeps], daemon=True)
    beside.start()
    code, _ = session.run([*words, *map(str, files)], seconds)  # other files may import packages that are missing here
    beside.join()
    return code


def bring_home(session: Session, runs: Path, out: Path, mib: float) -> None:
    """Write everything worth keeping to `out`."""
    folders = [path.parent for path in runs.rglob("config.json") if path.parent.name != "encoder"]
    stages = {folder: json.loads((folder / "config.json").read_text()).get("stage", "") for folder in folders}
    if any((folder / "timing.json").exists() for folder in folders):
        code, output = session.run(
            [*PROGRAM, "results", "add", str(runs), "--out", str(out / "results")], 60, quiet=True
        )
        session.say(f"rows: {output.strip()} ({code})")
    with tarfile.open(out / "records.tar.xz", "w:xz", preset=3) as file:
        for path in sorted(runs.rglob("*")):
            if path.suffix in (".json", ".jsonl", ".csv", ".log") and path.is_file():
                file.add(path, path.relative_to(runs))
    finished = [f for f, stage in stages.items() if stage == "pretrain" and (f / "timing.json").exists()]
    buffer, room = io.BytesIO(), mib * 2**20
    with tarfile.open(fileobj=buffer, mode="w") as file:
        for folder in sorted(finished, key=lambda folder: (folder / "encoder" / "model.safetensors").stat().st_size):
            files = [*folder.glob("*.json*"), *folder.glob("encoder/*")]
            room -= sum(path.stat().st_size + 2048 for path in files)
            if room < 0:
                break
            for path in files:
                file.add(path, path.relative_to(runs))
    content = buffer.getvalue() if mib and finished else b""
    for number, start in enumerate(range(0, len(content), PART_BYTES)):
        (out / f"encoders.tar.{number}").write_bytes(content[start : start + PART_BYTES])
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        session.say(f"{path.stat().st_size / 1e6:8.3f} MB  {path.relative_to(out)}")


def main() -> None:
    """Run all parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", metavar="PART", help="tests, bench or a grid; NAME=SECONDS limits it")
    parser.add_argument("--out", type=Path, required=True, help="what goes home")
    parser.add_argument("--work", type=Path, default=HERE / "work", help="runs and sets, which stay here")
    parser.add_argument("--home", type=Path, help="the --out of an earlier call")
    parser.add_argument("--seconds", type=float, default=570, help="all of it, packing included")
    parser.add_argument("--bring", type=float, default=0, metavar="MIB", help="encoders, up to this size in all")
    words = sys.argv[1:]
    at = words.index("--") if "--" in words else len(words)
    args, flags = parser.parse_args(words[:at]), words[at + 1 :]

    session = Session(args.out, args.seconds)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    args.work.mkdir(parents=True, exist_ok=True)
    done = args.home and (args.home / "results").is_dir()
    if args.home and (parts := sorted(args.home.glob("encoders.tar.*"))):  # to where the sweep finds them
        with tarfile.open(fileobj=io.BytesIO(b"".join(part.read_bytes() for part in parts))) as file:
            checked = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # from Python 3.11.4 on
            file.extractall(args.work / "runs", **checked)
    if done and args.home.resolve() != args.out.resolve():
        shutil.copytree(args.home / "results", args.out / "results", dirs_exist_ok=True)
    session.describe()
    session.find_renderer()
    try:
        parts = [(name, float(limit or "inf")) for name, _, limit in (part.partition("=") for part in args.parts)]
        words = ["--out", str(args.work / "runs"), "--data", str(args.work / "data"), *flags]
        words += ["--done", str(args.home / "results")] if done else []
        files = {name: HERE / name for name, _ in parts if name not in ("tests", "bench")}
        grids = {name: str(file) if file.is_file() else name for name, file in files.items()}
        sweeps = {name: [*PROGRAM, "sweep", "run", grid, *words] for name, grid in grids.items()}
        for name, limit in parts:
            seconds, began = min(limit, session.left()), time.monotonic()
            session.say(f"{name}: {seconds:.0f} s at most")
            if name == "tests":
                code = run_tests(session, seconds, list(sweeps.values()))
            elif name == "bench":
                trial = [] if session.gpu else ["--quick", "--device", "cpu"]
                code, _ = session.run([*PROGRAM, "bench", "--gpu", *trial], seconds)
            else:
                code = collect(session, sweeps[name], began + seconds)
                code = code or session.run(sweeps[name], began + seconds - time.monotonic())[0]
            session.say(f"{name}: {time.monotonic() - began:.1f} s, exit code {code}")
    finally:
        for process in session.processes:
            process.terminate()
        bring_home(session, args.work / "runs", args.out, args.bring)
        session.say("done")


if __name__ == "__main__":
    main()
