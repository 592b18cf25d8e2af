"""Writes the commit that is built into wheels and source archives; everything else is in pyproject.toml."""

import shutil
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOT = Path(__file__).resolve().parent
_SPEC = spec_from_file_location("provenance", ROOT / "vd4rl_pomdp" / "runs" / "provenance.py")
provenance = module_from_spec(_SPEC)  # by its path: the package's dependencies are not installed where it is built
_SPEC.loader.exec_module(provenance)


def record_commit(folder: str) -> None:
    """Write the commit below a folder of packages, if it is known."""
    if commit := provenance.git_commit():
        (Path(folder) / provenance.COMMIT_FILE).write_text(commit + "\n")


class BuildWithCommit(build_py):
    """Copies the packages, and adds the commit; an editable install asks its checkout instead."""

    def run(self) -> None:
        """Build, without modules that an earlier build left there and that no longer exist."""
        if not self.editable_mode:
            shutil.rmtree(self.build_lib, ignore_errors=True)
        super().run()
        if not self.editable_mode:
            record_commit(self.build_lib)


class ArchiveWithCommit(sdist):
    """Makes the archive's tree, and adds the commit."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Copy."""
        super().make_release_tree(base_dir, files)
        record_commit(base_dir)


setup(cmdclass={"build_py": BuildWithCommit, "sdist": ArchiveWithCommit})
