"""Pack everything that a machine with a GPU but no network needs into one file.

    python tools/card/pack.py card.tar.xz [--has FREEZE] [--python 3.12]

Run it in a checkout where pip has network access. The file holds this package with its commit, its dependencies pinned
by constraints.txt (without parts that it never imports), libraries that find the GPU's OpenGL, the tests, the grids,
and `run.py`, which runs on that machine. The machine has torch and numpy. FREEZE is its `pip freeze`: packages in a
suitable version there are left out. A line may be a name without a version.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from vd4rl_pomdp.runs.provenance import COMMIT_FILE, git_commit

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[2]
NAME = "card"
"""Folder in the archive."""
DROPPED = [
    *(f"dm_control/{room}" for room in ("blender", "composer", "entities", "locomotion", "manipulation", "mjcf")),
    *("dm_control/third_party", "dm_control/viewer", "dm_control/mujoco/testing", "dm_control/suite/dog_assets"),
    *("dm_control/suite/*.png", "mujoco/experimental", "mujoco/mjx", "bin", "**/tests", "**/*_test.py", "**/*.pyc"),
]
"""Files that no stage imports: 90% of dm_control, half of mujoco."""
PROJECT = ("vd4rl_pomdp", "pretrain", "finetune", "baselines", "pyproject.toml", "setup.py", "README.md", "LICENSE")
OPENGL = ("libegl1", "libglvnd0", "libopengl0", "libgl1", "libglx0", "libgles2")
"""Debian packages of the libraries that dispatch to a GPU's OpenGL; its driver brings the rest."""


def wanted(has: list[str]) -> list[str]:
    """Names in packages.txt that the machine lacks in a suitable version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ranges = {canonicalize_name(one.name): one.specifier for one in map(Requirement, project["dependencies"])}
    there = {}
    for line in has:
        name, version = re.match(r"([\w.-]+)(?:==(\S+))?", line).groups()
        there[canonicalize_name(name)] = version
    lines = (HERE / "packages.txt").read_text().splitlines()
    names = [canonicalize_name(line) for line in lines if line and not line.startswith("#")]
    other = {name for name, version in there.items() if version and name in ranges and version not in ranges[name]}
    return [name for name in names if name not in there or name in other]


def install(names: list[str], python: str, site: Path) -> None:
    """Install this package and others for another Python version into a folder."""
    platforms = [f"manylinux{which}_x86_64" for which in ("_2_28", "_2_27", "_2_24", "_2_17", "2014", "1")]
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    pip += ["--no-compile", "--target", str(site)]
    foreign = ["--only-binary=:all:", "--implementation", "cp", "--python-version", python, "--upgrade"]
    foreign += [word for platform in platforms for word in ("--platform", platform)]
    subprocess.run([*pip, *foreign, "-c", str(ROOT / "constraints.txt"), *names], check=True)
    with tempfile.TemporaryDirectory() as work:  # setuptools would add what an earlier build left in the checkout
        for path in map(ROOT.joinpath, PROJECT):
            (shutil.copytree if path.is_dir() else shutil.copy)(path, Path(work) / path.name)
        subprocess.run([*pip, "--no-build-isolation", work], check=True)
    (site / COMMIT_FILE).write_text(git_commit() + "\n")


def take_opengl(folder: Path) -> None:
    """Unpack OPENGL's libraries into a folder, if Debian's tools are available."""
    if not (shutil.which("apt-get") and shutil.which("dpkg")):
        print("no apt-get here: the machine needs its own libEGL", file=sys.stderr)
        return
    with tempfile.TemporaryDirectory() as work:
        subprocess.run(["apt-get", "download", "-qq", *(f"{name}:amd64" for name in OPENGL)], cwd=work, check=True)
        for file in Path(work).glob("*.deb"):
            subprocess.run(["dpkg", "-x", file, work], check=True)
        folder.mkdir(parents=True)
        for library in Path(work).glob("usr/lib/x86_64-linux-gnu/*.so*"):
            shutil.copy(library, folder)  # under each of its names


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--has", type=Path, help="pip freeze of the machine")
    parser.add_argument("--python", default="3.12", help="the machine's Python")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / NAME
        site = folder / "site"
        install(wanted(args.has.read_text().splitlines() if args.has else []), args.python, site)
        for pattern in DROPPED:
            for path in list(site.glob(pattern)):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        sizes = {path.name: sum(f.stat().st_size for f in path.rglob("*")) for path in site.iterdir() if path.is_dir()}
        for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:8]:
            print(f"{size / 1e6:7.1f} MB  {name}")
        take_opengl(folder / "opengl")
        for path in (HERE / "run.py", ROOT / "pyproject.toml", *HERE.glob("*.toml")):
            shutil.copy(path, folder)
        shutil.copytree(ROOT / "tests", folder / "tests", ignore=shutil.ignore_patterns("__pycache__"))
        with tarfile.open(args.out, "w:xz") as file:
            file.add(folder, NAME)
    print(f"{args.out.stat().st_size / 1e6:7.1f} MB  {args.out}")


if __name__ == "__main__":
    main()
