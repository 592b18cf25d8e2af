"""Parts by name: the package's own, those added by a call, and those that installed packages offer as entry points."""

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
"""Origin of the parts that a process has added itself."""
REGISTRIES: dict[str, Registry[Any]] = {}
"""Every registry by its kind, in the order in which they were made."""


class Registry(Mapping[str, Part], Generic[Part]):
    """All parts of one kind; reading it loads what installed packages offer, once."""

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
        """See the class.

        Args:
            kind: what a part is called in messages, `frame encoder`; its plural with underscores names the group of
                entry points, `vd4rl_pomdp.frame_encoders`, and it is the setting that names a part, `frame_encoder`.
            own: the package's parts by name.
            fits: whether an object is a part of this kind.
            expected: what such an object is, for messages.
            refuse: raises UserError, without naming the part, for a name or an object of this kind that cannot work.
            setting: the setting that names a part, if it is not called as the kind.
            group: the group of entry points, if the kind's plural is another.
        """
        self.kind, self.setting = kind, setting or kind.replace(" ", "_")
        self.group = group or f"vd4rl_pomdp.{self.setting}s"
        self.broken: dict[str, str] = {}
        """Offered parts that cannot be loaded, and why."""
        self._parts = dict(own)
        self._origins: dict[str, str] = {}
        self.sources: dict[str, str] = {}
        """Of parts that are not this package's, but for a notebook's cells: the file that registered or offers them and
        its hash when it was loaded, since that is what runs."""
        self._fits, self._expected, self._refuse = fits, expected, refuse
        self._loaded = False
        REGISTRIES[self.setting] = self

    def register(self, name: str, part: Part, replace: bool = False) -> None:
        """Add a part of one's own; a name that is taken, or a part that cannot work, raises UserError.

        Args:
            name: what it is called by.
            part: the part.
            replace: whether it may take the place of one that such a call added, as where a notebook's cell runs again.
        """
        self._add(name, part, BY_CALL, sys._getframe(1).f_code.co_filename, replace)

    @property
    def has_added(self) -> bool:
        """Whether this process has added a part by a call."""
        return BY_CALL in self._origins.values()

    def registered(self) -> dict[str, Part]:
        """The parts that are known without loading what installed packages offer: for code that runs at import."""
        return dict(self._parts)

    @contextmanager
    def isolated(self) -> Iterator[None]:
        """Within the block parts may be registered; after it they are forgotten, as tests want it."""
        self._load_offered()
        before = dict(self._parts), dict(self._origins), dict(self.sources)
        try:
            yield
        finally:
            self._parts, self._origins, self.sources = before

    def named(self, name: str) -> Part:
        """The part called `name`; raises UserError listing the choices, or saying why it cannot be loaded."""
        self._load_offered()
        if name in self.broken and name not in self._parts:
            raise UserError(
                f"{self.kind} {name!r} cannot be loaded ({self.broken[name]}): mend or remove what offers it"
            )
        refuse_unknown(self.kind, name, self._parts, OR_ONES_OWN)
        return self._parts[name]

    def origin(self, name: str) -> str:
        """Where a part comes from: a package and its version, a call, or "" for this package's own."""
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
                f"{self.kind} {name!r}: folders and `--only` are made of names, without slashes, commas, blanks or "
                "equals signs: choose another"
            )
        try:
            self._refuse(name, part)
        except UserError as error:
            raise UserError(f"{self.kind} {name!r}: {error}") from None
        self._parts[name], self._origins[name] = part, origin
        self.sources.pop(name, None)
        if (path := Path(file)).is_file():  # hashed now: it may be edited while this process runs what it said before
            self.sources[name] = f"{path.name} {sha256(path.read_bytes()).hexdigest()[:12]}"

    def _load_offered(self) -> None:
        """Add what installed packages offer; what cannot be loaded is told of once, and left out."""
        if self._loaded:
            return
        self._loaded = True  # first: a package may look into this registry while it is loaded
        for entry in entry_points(group=self.group):
            try:
                part = entry.load()
                origin = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an installed package"
                self._add(entry.name, part, origin, getattr(sys.modules[entry.module], "__file__", None) or "")
            except Exception as error:  # other people's code may raise anything
                reason = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
                self.broken[entry.name] = f"{entry.value}: {' '.join(reason.split())}"
                warning = f"warning: {self.kind} {entry.name!r} cannot be loaded ({self.broken[entry.name]})"
                print(warning, file=sys.stderr)


def code_of(settings: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """What a record keeps of the parts that settings name and that are not this package's own.

    Args:
        settings: a stage's settings by name; those that name parts are called as the registries' `setting`.

    Returns:
        `plugins`: where they come from, {"method mine": "its 1.2"}.
        `sources`: their files and hashes of them, {"method mine": "mine.py 0123456789ab"}.
    """
    plugins, sources = dict[str, str](), dict[str, str]()
    for setting, registry in list(REGISTRIES.items()):  # a package that is loaded may make further ones
        value = str(settings.get(setting, ""))
        for name in [value] if value in registry else value.split("+"):
            part = f"{setting} {name}"
            plugins |= {part: origin} if (origin := registry.origin(name)) else {}
            sources |= {part: registry.sources[name]} if name in registry.sources else {}
    return {"plugins": plugins, "sources": sources}


def of_other_code(record: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """The parts that settings name and whose file or package is another by now than the one a run's record tells of."""
    here = code_of(settings)
    changed = [part for kind in here for part, now in here[kind].items() if record.get(kind, {}).get(part, now) != now]
    return list(dict.fromkeys(changed))


def warn_of_other_code(place: object, record: Mapping[str, Any], settings: Mapping[str, Any], what: str) -> None:
    """Tell of each part whose code is another by now.

    Args:
        place: what was made with the earlier code.
        record: what it says of that, as `code_of` does.
        settings: what names the parts.
        what: since when, and what that means: ends the sentence.
    """
    for part in of_other_code(record, settings):
        print(f"warning: {place}: the code of {part} has changed since {what}", file=sys.stderr)
