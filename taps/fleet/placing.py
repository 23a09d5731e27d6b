"""What a fleet shares, put to its place on a robot: checked before, never half written, never an older one.

Nothing here knows Zenoh: offers and bytes in, files out.
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

from daemon.config.paths import maps_folder, state_folder
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
"""Behind the name of a survey that was replaced; and a number, from the second one on."""


class Refused(Exception):
    """It is not taken; the text says why and what to do."""


class Offer(msgspec.Struct, frozen=True, kw_only=True):
    """What somebody shares, but for the content: key ``lumiloop/@shared/<kind>``.

    ``version``: a larger one is newer. ``map_id``: of a map, else 0.
    """

    schema: int = SCHEMA
    kind: str
    name: str
    version: Annotated[int, Meta(ge=0)]
    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
    size: Annotated[int, Meta(ge=0, le=MOST_BYTES)]
    map_id: Annotated[int, Meta(ge=0, lt=1 << 32)] = 0

    def said(self) -> str:
        """For people."""
        return f"{self.kind} {printable(self.name)} version {self.version}"


def sha256_of(content: bytes) -> str:
    """In hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def offer_of(kind: str, path: Path, version: int | None) -> tuple[Offer, bytes]:
    """A file that is to be shared; without a version, the seconds at which the file was changed last.

    Raises:
        Refused: it cannot be read, or is none that a robot could use.
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
        Refused: it is no map that could be used.
    """
    try:
        return read(content).meta.map_id
    except BadMap as error:
        raise Refused(f"{name}: {error}") from None


def survey_in(content: bytes, name: str, profile: Profile | None = None) -> Survey:
    """The survey in a file; ``profile``: air interface that its lamps have to have, None: any.

    Raises:
        Refused: it is none that could be used.
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
        raise Refused(f"{name}: cannot be checked, for want of a temporary file: {reason_of(error)}") from None


class Taken(Held, frozen=True):
    """What has been put to its place, ``path``; ``switched``: the daemon has gone on in it when asked."""

    path: str = ""
    map_id: int = 0
    switched: bool = False

    def kept_in(self) -> Path | None:
        """The survey's file, or the folder of maps, if it is still there; a daemon renames the map with every save."""
        path = Path(self.path)
        if not self.path or not self.map_id:
            return path if self.path and path.exists() else None
        with contextlib.suppress(OSError):
            if any(one.map_id == self.map_id for one in Store(path.parent, mend=False).generations()):
                return path.parent
        return None


class Records:
    """What this robot has taken, in a file of the state directory; read anew where it has changed."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or state_folder() / RECORD
        self._read: tuple[int, dict[str, Taken]] = -1, {}

    def taken(self) -> dict[str, Taken]:
        """By kind, as noted; empty where there is none, or the file cannot be read."""
        try:
            changed = self.path.stat().st_mtime_ns
        except OSError:
            return {}
        if changed != self._read[0]:
            found: dict[str, Taken] = {}
            with contextlib.suppress(OSError, msgspec.DecodeError, UnicodeDecodeError):
                found = msgspec.json.decode(self.path.read_bytes(), type=dict[str, Taken])
            self._read = changed, found
        return self._read[1]

    def held(self) -> dict[str, Held]:
        """What of it is still in its place, for the fleet."""
        return {
            kind: Held(one.version, one.sha256, one.name)
            for kind, one in self.taken().items()
            if one.kept_in() is not None
        }

    def note(self, offer: Offer, where: Path) -> Taken:
        """It has been put there; raises `OSError`."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        one = Taken(offer.version, offer.sha256, offer.name, str(where.absolute()), offer.map_id)
        self._write(offer.kind, one)
        return one

    def switched(self, one: Taken) -> None:
        """The daemon goes on in that map; raises `OSError`."""
        self._write(MAP, msgspec.structs.replace(one, switched=True))

    def _write(self, kind: str, one: Taken) -> None:
        taken = {**self.taken(), kind: one}
        write_whole(self.path, msgspec.json.format(msgspec.json.encode(taken), indent=2) + b"\n")


def chosen(kind: str, offers: list[Offer], held: Held | None) -> Offer | None:
    """The newest of what is offered; None: it is here already.

    Raises:
        Refused: nothing is offered, or what is offered is older, or contradicts itself or what is here.
    """
    fitting = [offer for offer in offers if offer.kind == kind]
    if not fitting:
        raise Refused(f"nobody shares a {kind}: `lumiloop fleet share --{kind} FILE` does")
    newest = max(fitting, key=lambda offer: offer.version)
    contents = {offer.sha256 for offer in fitting if offer.version == newest.version}
    if held is not None and held.version == newest.version:
        contents.add(held.sha256)
    if len(contents) > 1:
        raise Refused(
            f"{kind} version {newest.version} is there with {len(contents)} different contents; share the right one "
            f"with --version {newest.version + 1}"
        )
    if held is not None and held.version > newest.version:
        raise Refused(
            f"{newest.said()} is older than version {held.version}, which is here; to go back to it, share it with "
            f"--version {held.version + 1}"
        )
    return None if held is not None and held.version == newest.version else newest


def check(offer: Offer, content: bytes) -> None:
    """Whether what came is what was offered.

    Raises:
        Refused: it is not.
    """
    if len(content) != offer.size or sha256_of(content) != offer.sha256:
        raise Refused(
            f"{offer.said()}: what came ({len(content)} bytes) is not what was announced ({offer.size} bytes, SHA-256 "
            f"{offer.sha256[:12]}...); nothing is changed"
        )


def place(offer: Offer, content: bytes, settings: Config, survey: Path | None) -> tuple[Path, str]:
    """Check what came and put it to its place; where that is, and what else a person should know.

    Raises:
        Refused: it cannot be used, or cannot be put there. Nothing is changed then.
    """
    check(offer, content)
    if offer.kind == MAP:
        map_id = map_id_of(content, offer.name)
        if map_id != offer.map_id:
            raise Refused(f"{offer.said()}: holds map {map_id:08x}, not {offer.map_id:08x} as announced")
        return place_map(content, map_id, settings)
    where = home(SURVEY, settings, survey)
    profile = PROFILES[settings.photodiode.profile]
    return place_survey(survey_in(content, offer.name, profile), where)


def home(kind: str, settings: Config, survey: Path | None) -> Path:
    """Where it goes: the survey's file, or the folder of maps; ``survey``: as the command line names it.

    Raises:
        Refused: nobody has said so.
    """
    if kind == MAP:
        if not settings.map.kept:
            raise Refused("maps are not kept: `map.folder` is none")
        return maps_folder(settings.map.folder).absolute()
    if survey is None and not settings.lights.survey:
        raise Refused("where should the survey go? set `lights.survey`, or name a file with --survey FILE")
    return (survey or Path(settings.lights.survey)).absolute()


def place_map(content: bytes, map_id: int, settings: Config) -> tuple[Path, str]:
    """As the newest generation in the folder of maps, where the next start takes it."""
    store = Store(home(MAP, settings, None), mend=False)
    try:
        return keep(settings, content, map_id), "the next start goes on in it"
    except BadMap as error:
        raise Refused(f"{store.folder}: {error}") from None
    except OSError as error:
        if not isinstance(error.__cause__, BlockingIOError):
            raise Refused(str(error)) from None
    return _beside_daemon(store, content, map_id)


def _beside_daemon(store: Store, content: bytes, map_id: int) -> tuple[Path, str]:
    """A daemon keeps its maps there, in files that are named after the map: of another map they are nobody's but ours.

    Raises:
        Refused: the daemon may be about to write that map itself.
    """
    try:
        generations = store.generations()
        if any(one.map_id == map_id for one in generations):
            raise Refused(
                f"{store.folder}: a running daemon keeps map {map_id:08x} there itself; stop it, and try again"
            )
        number = 1 + max((one.number for one in generations), default=0)
        path = store.folder / f"map-{map_id:08x}-{number:08d}.lumimap"
        write_whole(path, content)
    except OSError as error:
        raise Refused(f"{store.folder}: {reason_of(error)}") from None
    return path, "the daemon that runs goes on in its own map: --switch asks it to change"


def place_survey(shared: Survey, where: Path) -> tuple[Path, str]:
    """The shared lamps with the receiver that this robot has; what was there before stays beside.

    Raises:
        Refused: it cannot be written, or what is there cannot be read.
    """
    words = "its receiver is the shared file's: look at [receiver]"
    try:
        if where.exists():
            own, old = read_survey(where), where.read_bytes()
            shared = replace(shared, receiver=own.receiver)
            aside = _aside(where, old)
            words = f"[receiver] is this robot's own as before; the old file is {aside.name}"
            write_whole(aside, old)
        write_whole(where, dump(shared, ("Lamps as shared in the fleet.",)).encode())
    except SurveyError as error:
        raise Refused(f"{error}; mend it, or move it away") from None
    except OSError as error:
        raise Refused(f"{where}: cannot be written: {reason_of(error)}") from None
    return where, f"the daemon takes it at its next start; {words}"


def _aside(where: Path, old: bytes) -> Path:
    """Where the old file goes: over none that holds anything else, for one of these is the robot's own."""
    names = (
        where.with_name(f"{where.name}{BEFORE}{number}")
        for number in itertools.chain(("",), map(str, itertools.count(2)))
    )
    return next(path for path in names if not path.exists() or path.read_bytes() == old)
