"""Plug-ins by name: the package's own, those registered by a call, and entry points of installed packages."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import sha256
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Generic, TypeVar

from vd4rl_pomdp.core.errors import OR_ONES_OWN, UserError, refuse_unknown

Part = TypeVar("Part")
BY_CALL = "registered by a call"
"""Origin of plug-ins that this process registered itself."""
REGISTRIES: dict[str, Registry[Any]] = {}
"""Every registry by its setting, in order of creation."""


class Registry(Mapping[str, Part], Generic[Part]):
    """All plug-ins of one kind. The first access loads those of installed packages.

    Args:
        kind: name of the kind in messages, e.g. `frame encoder`. It also gives the setting that names a plug-in,
            `frame_encoder`, and the entry-point group, `vd4rl_pomdp.frame_encoders`.
        own: the package's plug-ins by name.
        fits: whether an object is a plug-in of this kind.
        expected: description of such an object, for messages.
        refuse: raises UserError for a name or object of this kind that cannot work; it need not name the plug-in.
        setting: the setting that names a plug-in, if not derived from `kind`.
        group: the entry-point group, if not derived from the setting.
    """

    def __init__(
        self,
        kind: str,
        own: Mapping[str, Part],
        fits: Callable[[Any], bool],
        expected: str,
        refuse: Callable[[str, Any], None] = lambda name, part: None,
        setting: str = "",
        group: str = "",
    ) -> None:
        self.kind, self.setting = kind, setting or kind.replace(" ", "_")
        self.group = group or f"vd4rl_pomdp.{self.setting}s"
        self.broken: dict[str, str] = {}
        """Entry points that could not be loaded, and why."""
        self._parts = dict(own)
        self._origins: dict[str, str] = {}
        self.sources: dict[str, str] = {}
        """By name of third-party plug-ins: the file that defines one and the file's hash when it was loaded. Plug-ins
        defined in notebook cells have no file."""
        self._fits, self._expected, self._refuse = fits, expected, refuse
        self._loaded = False
        REGISTRIES[self.setting] = self

    def register(self, name: str, part: Part, replace: bool = False) -> None:
        """Add your own plug-in; UserError if the name is taken or the plug-in cannot work.

        `replace`: it may replace one added by such a call, e.g. when a notebook cell is run again.
        """
        self._add(name, part, BY_CALL, sys._getframe(1).f_code.co_filename, replace)

    @property
    def has_added(self) -> bool:
        return BY_CALL in self._origins.values()

    def registered(self) -> dict[str, Part]:
        """The plug-ins known so far, without loading entry points: for code that runs at import."""
        return dict(self._parts)

    @contextmanager
    def isolated(self) -> Iterator[None]:
        """Forget registrations made within the block, for tests."""
        self._load_offered()
        before = dict(self._parts), dict(self._origins), dict(self.sources)
        try:
            yield
        finally:
            self._parts, self._origins, self.sources = before

    def named(self, name: str) -> Part:
        """The plug-in called `name`; otherwise UserError with the choices, or the reason why it could not be loaded."""
        self._load_offered()
        if name in self.broken and name not in self._parts:
            raise UserError(
                f"{self.kind} {name!r} cannot be loaded ({self.broken[name]}): fix or uninstall its package"
            )
        refuse_unknown(self.kind, name, self._parts, OR_ONES_OWN)
        return self._parts[name]

    def origin(self, name: str) -> str:
        """Where a plug-in comes from: a package and version, BY_CALL, or "" for this package's own."""
        self._load_offered()
        return self._origins.get(name, "")

    def __getitem__(self, name: str) -> Part:
        self._load_offered()
        return self._parts[name]

    def __iter__(self) -> Iterator[str]:
        self._load_offered()
        return iter(tuple(self._parts))

    def __len__(self) -> int:
        self._load_offered()
        return len(self._parts)

    def _add(self, name: str, part: Any, origin: str, file: str, replace: bool = False) -> None:
        if name in self._parts and not (replace and origin == BY_CALL == self._origins.get(name)):
            raise UserError(f"a {self.kind} called {name!r} exists already: choose another name")
        if not self._fits(part):
            raise UserError(f"{self.kind} {name!r} is a {type(part).__name__}, not {self._expected}")
        if name in ("", ".", "..") or any(sign in name for sign in "/,= "):
            raise UserError(
                f"{self.kind} {name!r}: names are part of paths and of `--only` and must not contain slashes, commas, "
                "spaces or equals signs: choose another"
            )
        try:
            self._refuse(name, part)
        except UserError as error:
            raise UserError(f"{self.kind} {name!r}: {error}") from None
        self._parts[name], self._origins[name] = part, origin
        self.sources.pop(name, None)
        if (path := Path(file)).is_file():  # hash now: the file may be edited while this process runs the old code
            self.sources[name] = f"{path.name} {sha256(path.read_bytes()).hexdigest()[:12]}"

    def _load_offered(self) -> None:
        """Add the entry points of installed packages; warn about those that cannot be loaded."""
        if self._loaded:
            return
        self._loaded = True  # set first: a package may read this registry while it is loaded
        for entry in entry_points(group=self.group):
            try:
                part = entry.load()
                origin = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an installed package"
                self._add(entry.name, part, origin, getattr(sys.modules[entry.module], "__file__", None) or "")
            except Exception as error:  # third-party code may raise anything
                reason = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
                self.broken[entry.name] = f"{entry.value}: {' '.join(reason.split())}"
                warning = f"warning: {self.kind} {entry.name!r} cannot be loaded ({self.broken[entry.name]})"
                print(warning, file=sys.stderr)


def code_of(settings: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """Origin and source hashes of the third-party plug-ins that a stage's settings name, for a run's record.

    Returns:
        `plugins`: where they come from, {"method mine": "its 1.2"}.
        `sources`: their files and hashes, {"method mine": "mine.py 0123456789ab"}.
    """
    plugins, sources = dict[str, str](), dict[str, str]()
    for setting, registry in list(REGISTRIES.items()):  # loading a package may create more registries
        value = str(settings.get(setting, ""))
        for name in [value] if value in registry else value.split("+"):
            part = f"{setting} {name}"
            plugins |= {part: origin} if (origin := registry.origin(name)) else {}
            sources |= {part: registry.sources[name]} if name in registry.sources else {}
    return {"plugins": plugins, "sources": sources}


def of_other_code(record: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Plug-ins named in settings whose code differs from that in a run's record."""
    here = code_of(settings)
    changed = [part for kind in here for part, now in here[kind].items() if record.get(kind, {}).get(part, now) != now]
    return list(dict.fromkeys(changed))


def warn_of_other_code(place: object, record: Mapping[str, Any], settings: Mapping[str, Any], what: str) -> None:
    """Warn about each plug-in named in settings whose code has changed since `record`, from `code_of`.

    `place` is what was made with the earlier code; `what` ends the sentence: since when, and what it means.
    """
    for part in of_other_code(record, settings):
        print(f"warning: {place}: the code of {part} has changed since {what}", file=sys.stderr)
