"""Installs shared surveys and maps on a robot: checked first, written atomically, never older than the present one.

Independent of Zenoh: offers and bytes in, files out.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from daemon.config.paths import stored_maps
from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError, dump, read_survey
from daemon.maps.container import BadMap
from daemon.maps.edit import keep
from daemon.maps.schema import read
from daemon.maps.store import Store
from daemon.system.atomic_file import reason_of, write_whole
from estimator import PROFILES, Profile, Survey
from taps.fleet.messages import SCHEMA, Held, printable

SURVEY, MAP = "survey", "map"
KINDS: Final = (SURVEY, MAP)
MOST_BYTES: Final = 256 << 20
RECORD: Final = "fleet.json"
BEFORE: Final = ".before"
"""Suffix of a replaced survey, followed by a number from the second one on."""


class Refused(Exception):
    """A shared file that is not accepted; the text gives the cause and a remedy."""


class Offer(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a shared file, without its content: key ``lumiloop/@shared/<kind>``.

    ``version``: a larger one is newer. ``map_id``: of a map, else 0.
    """

    schema: int = SCHEMA
    kind: str
    name: str
    version: Annotated[int, Meta(ge=0)]
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
    size: Annotated[int, Meta(ge=0, le=MOST_BYTES)]
    map_id: Annotated[int, Meta(ge=0, lt=1 << 32)] = 0

    def label(self) -> str:
        """Kind, name and version as text."""
        return f"{self.kind} {printable(self.name)} version {self.version}"


def sha256_of(content: bytes) -> str:
    """SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def offer_of(kind: str, path: Path, version: int | None) -> tuple[Offer, bytes]:
    """Offer and content of a file; the default version is its modification time (s).

    Raises:
        Refused: unreadable, or not usable by a robot.
    """
    try:
        content = path.read_bytes()
        changed = int(path.stat().st_mtime)
    except OSError as error:
        raise Refused(f"{path}: cannot be read: {reason_of(error)}") from None
    offer = Offer(
        kind=kind,
        name=path.name,
        version=changed if version is None else version,
        sha256=sha256_of(content),
        size=len(content),
        map_id=map_id_of(content, str(path)) if kind == MAP else 0,
    )
    if kind == SURVEY:
        survey_in(content, str(path))
    return offer, content


def map_id_of(content: bytes, name: str) -> int:
    """Identity of the map in a file.

    Raises:
        Refused: not a usable map.
    """
    try:
        return read(content).meta.map_id
    except BadMap as error:
        raise Refused(f"{name}: {error}") from None


def survey_in(content: bytes, name: str, profile: Profile | None = None) -> Survey:
    """The survey in a file; ``profile``: required air interface profile of its lamps, None: any.

    Raises:
        Refused: not a usable survey.
    """
    try:
        with tempfile.TemporaryDirectory(prefix="lumiloop-fleet-") as folder:
            path = Path(folder) / "survey"
            path.write_bytes(content)
            try:
                return read_survey(path, profile)
            except SurveyError as error:
                raise Refused(str(error).replace(str(path), name)) from None
    except OSError as error:
        raise Refused(
            f"{name}: cannot be checked, because no temporary file can be written: {reason_of(error)}"
        ) from None


class Installed(Held, frozen=True):
    """An installed file at ``path``; ``switched``: the daemon was switched to it."""

    path: str = ""
    map_id: int = 0
    switched: bool = False

    def kept_in(self) -> Path | None:
        """The survey's file, or the folder of maps, if it still exists; a daemon renames the map with every save."""
        path = Path(self.path)
        if not self.path or not self.map_id:
            return path if self.path and path.exists() else None
        with contextlib.suppress(OSError):
            if any(one.map_id == self.map_id for one in Store(path.parent, mend=False).generations()):
                return path.parent
        return None


class Records:
    """Records of the installed files, in a file beside the folder of maps; read again after a change."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or stored_maps("").parent / RECORD
        self._read: tuple[int, dict[str, Installed]] = -1, {}

    def taken(self) -> dict[str, Installed]:
        """Installed files by kind; empty where the record is missing or unreadable."""
        try:
            changed = self.path.stat().st_mtime_ns
        except OSError:
            return {}
        if changed != self._read[0]:
            found: dict[str, Installed] = {}
            with contextlib.suppress(OSError, msgspec.DecodeError, UnicodeDecodeError):
                found = msgspec.json.decode(self.path.read_bytes(), type=dict[str, Installed])
            self._read = changed, found
        return self._read[1]

    def held(self) -> dict[str, Held]:
        """Installed files that still exist, for the fleet's state message."""
        return {
            kind: Held(one.version, one.sha256, one.name)
            for kind, one in self.taken().items()
            if one.kept_in() is not None
        }

    def note(self, offer: Offer, where: Path) -> Installed:
        """Record an installation; raises `OSError`."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        one = Installed(offer.version, offer.sha256, offer.name, str(where.absolute()), offer.map_id)
        self._write(offer.kind, one)
        return one

    def switched(self, one: Installed) -> None:
        """Record that the daemon was switched to that map; raises `OSError`."""
        self._write(MAP, msgspec.structs.replace(one, switched=True))

    def _write(self, kind: str, one: Installed) -> None:
        taken = {**self.taken(), kind: one}
        write_whole(self.path, msgspec.json.format(msgspec.json.encode(taken), indent=2) + b"\n")


def newest_offer(kind: str, offers: list[Offer], held: Held | None) -> Offer | None:
    """The newest offer of a kind; None: it is installed already.

    Raises:
        Refused: no offer, an older one, or different contents under one version.
    """
    fitting = [offer for offer in offers if offer.kind == kind]
    if not fitting:
        raise Refused(f"no robot shares a {kind}; share one with `lumiloop fleet share --{kind} FILE`")
    newest = max(fitting, key=lambda offer: offer.version)
    contents = {offer.sha256 for offer in fitting if offer.version == newest.version}
    if held is not None and held.version == newest.version:
        contents.add(held.sha256)
    if len(contents) > 1:
        raise Refused(
            f"{kind} version {newest.version} exists with {len(contents)} different contents; share the right "
            f"one with --version {newest.version + 1}"
        )
    if held is not None and held.version > newest.version:
        raise Refused(
            f"{newest.label()} is older than version {held.version}, which is installed; to use it again, "
            f"share it with --version {held.version + 1}"
        )
    return None if held is not None and held.version == newest.version else newest


def check(offer: Offer, content: bytes) -> None:
    """Compare the received content with its offer.

    Raises:
        Refused: they differ.
    """
    if len(content) != offer.size or sha256_of(content) != offer.sha256:
        raise Refused(
            f"{offer.label()}: the content ({len(content)} bytes) differs from the announced one "
            f"({offer.size} bytes, SHA-256 {offer.sha256[:12]}...); nothing is changed"
        )


def install(offer: Offer, content: bytes, settings: Config, survey: Path | None) -> tuple[Path, str]:
    """Check and install a content; returns its path and a note for the user.

    Raises:
        Refused: not usable, or it cannot be written. Nothing is changed then.
    """
    check(offer, content)
    if offer.kind == MAP:
        map_id = map_id_of(content, offer.name)
        if map_id != offer.map_id:
            raise Refused(f"{offer.label()}: contains map {map_id:08x}, not {offer.map_id:08x} as announced")
        return place_map(content, map_id, settings)
    where = target_path(SURVEY, settings, survey)
    profile = PROFILES[settings.photodiode.profile]
    return place_survey(survey_in(content, offer.name, profile), where)


def target_path(kind: str, settings: Config, survey: Path | None) -> Path:
    """Target path: the survey's file, or the folder of maps; ``survey``: of the command line.

    Raises:
        Refused: not configured.
    """
    if kind == MAP:
        if not settings.map.kept:
            raise Refused("maps are not stored, because `map.folder` is none")
        return stored_maps(settings.map.folder).absolute()
    if survey is None and not settings.lights.survey:
        raise Refused("no file for the survey is known; set `lights.survey`, or name a file with --survey FILE")
    return (survey or Path(settings.lights.survey)).absolute()


def place_map(content: bytes, map_id: int, settings: Config) -> tuple[Path, str]:
    """Install a map as the newest generation in the folder of maps, for the next start."""
    store = Store(target_path(MAP, settings, None), mend=False)
    try:
        return keep(settings, content, map_id), "the next start uses it"
    except BadMap as error:
        raise Refused(f"{store.folder}: {error}") from None
    except OSError as error:
        if not isinstance(error.__cause__, BlockingIOError):
            raise Refused(str(error)) from None
    return _place_beside_daemon(store, content, map_id)


def _place_beside_daemon(store: Store, content: bytes, map_id: int) -> tuple[Path, str]:
    """Install a map into a running daemon's folder: file names contain the map's ID, so that another map is safe.

    Raises:
        Refused: the daemon itself keeps a map of that ID.
    """
    try:
        generations = store.generations()
        if any(store.identity(one) == map_id for one in generations):
            raise Refused(
                f"{store.folder}: a running daemon keeps map {map_id:08x} there; stop the daemon and try again"
            )
        number = 1 + max((one.number for one in generations), default=0)
        path = store.folder / f"map-{map_id:08x}-{number:08d}.lumimap"
        write_whole(path, content)
    except OSError as error:
        raise Refused(f"{store.folder}: {reason_of(error)}") from None
    return path, "the running daemon keeps its map; use --switch to change it"


def place_survey(shared: Survey, where: Path) -> tuple[Path, str]:
    """Install the shared lamps with this robot's own receiver; the old file is kept under another name.

    Raises:
        Refused: the file cannot be written, or the present one cannot be read.
    """
    words = "its receiver comes from the shared file; check [receiver]"
    try:
        if where.exists():
            own, old = read_survey(where), where.read_bytes()
            shared = replace(shared, receiver=own.receiver)
            backup = _backup_path(where, old)
            words = f"[receiver] of this robot is unchanged; the old file is {backup.name}"
            write_whole(backup, old)
        write_whole(where, dump(shared, ("Lamps as shared in the fleet.",)).encode())
    except SurveyError as error:
        raise Refused(f"{error}; correct it, or move the file away") from None
    except OSError as error:
        raise Refused(f"{where}: cannot be written: {reason_of(error)}") from None
    return where, f"the daemon uses it at its next start; {words}"


def _backup_path(where: Path, old: bytes) -> Path:
    """Path for the old file: the first unused one, or one with the same content."""
    names = (
        where.with_name(f"{where.name}{BEFORE}{number}")
        for number in itertools.chain(("",), map(str, itertools.count(2)))
    )
    return next(path for path in names if not path.exists() or path.read_bytes() == old)
