"""`lumiloop export RECORDING --mcap OUT.mcap`: converts a recording, or a flight recorder's dump, to other formats.

The recording is replayed: the output is what the daemon published then, with covariances. If the replay ends early, the
cause is printed and the output up to there is kept.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from daemon.replay.recorded_inputs import Given
from daemon.replay.results import OutputRefused, doubt, kitti, tum
from daemon.runtime import warmup
from daemon.system import console
from daemon.system.atomic_file import write_whole
from daemon.system.extras import how_to_install
from daemon.system.versions import made_elsewhere
from hal.errors import HalError
from taps.stream.recording_source import RecordingSource

if TYPE_CHECKING:  # an extra that a trajectory alone does not need
    from taps.mcap.writer import McapFile
    from taps.ros.messages import Translator

GROWTH: Final = 1.25
"""The map is written again once its keyframes have grown by this factor, so that a long drive has few maps."""
FIRST_MAP: Final = 5
IN_A_LOG_S: Final = 10.0
"""Period of progress lines where standard error is no terminal."""


class OutputConflict(Exception):
    """An output that would overwrite the input or another output, or that cannot be written."""


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    try:
        with _stoppable():
            return _save(args) if args.source is None else _export(args)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in ("daemon", "estimator", "hal", "taps"):
            raise
        return console.fail(f"MCAP files need {error.name}, which is not installed: {how_to_install('mcap')}")
    except OutputConflict as error:
        return console.fail(str(error), console.USAGE)
    except (HalError, OutputRefused, warmup.CannotLoad) as error:
        return console.fail(str(error))
    except OSError as error:
        return console.fail(f"{error.filename or args.log}: {error.strerror}; free space or name another file")


def _save(args: argparse.Namespace) -> int:
    """Recover an MCAP file: copy its intact messages."""
    from taps.mcap.recover import NotMcap, recover

    if args.tum or args.kitti:
        problem = f"{args.log} is an MCAP file; only --mcap is possible, which recovers its complete messages"
        return console.fail(f"{problem}; make trajectories from the recording itself", console.USAGE)
    _check_outputs((args.log,), args)
    try:
        found = recover(args.log, args.mcap)
    except NotMcap as error:
        return console.fail(str(error))
    console.say(f"{args.mcap}: {found.sentence()}")
    return console.OK


def _export(args: argparse.Namespace) -> int:
    keys = tuple(override.partition("=")[0].strip() for override in args.set)
    source = RecordingSource(args.source, args.settings, Given(args.config is not None, keys))
    _check_outputs(source.source.files, args)
    if made := made_elsewhere(source.source.header):
        console.say(f"{args.log}: {made}")
    stopped = ""
    if args.mcap is None:
        stopped = _run(source, None, None)
    else:
        from taps.mcap.writer import McapFile
        from taps.ros.messages import Translator

        with _replaced_on_success(args.mcap) as path, McapFile(path, flush_s=0.0) as file:
            translator = Translator(source.config.lidar.mount, source.source.utc)
            stopped = _run(source, translator, file)
            _draw(source, translator, file)
        console.say(f"{args.mcap}: {file.messages} messages")
    final = (source.rerun.ledger.online() if args.online else source.rerun.ledger.final()).ordered()
    guesses = sum(map(bool, final.guesses()))
    guessed = f", and {guesses} unconfirmed poses that are omitted" if guesses else ""
    for path, text in ((args.tum, tum), (args.kitti, kitti)):
        if path is not None:
            write_whole(path, text(final))
            none = "" if len(final.stamps) else "; no cycle in the recording had a pose"
            console.say(f"{path}: {len(final.stamps) - guesses} poses{guessed}{none}")
    for sentence in source.source.report.sentences():
        console.say(f"{args.log}: {sentence}")
    if source.rerun.comparison.differ:
        count, first = source.rerun.comparison.differ, source.rerun.comparison.first
        console.say(
            f"the replay differs from the recorded run in {count} cycles: the software differs, or records "
            f"are lost; first {first}"
        )
    if sentence := doubt(source.rerun.ledger.online()):
        console.say(f"{args.log}: {sentence}")
    return console.fail(f"{stopped}; the part before it is written") if stopped else console.OK


def _check_outputs(read: Iterable[Path], args: argparse.Namespace) -> None:
    """Check the outputs before the replay: none may be the input, a second output, or an existing MCAP file.

    Raises:
        OutputConflict: naming the option.
    """
    taken = {path.resolve(): "the input file" for path in read}
    for option in ("mcap", "tum", "kitti"):
        target: Path | None = getattr(args, option)
        if target is None:
            continue
        if target.resolve() in taken:
            raise OutputConflict(f"--{option} {target}: this is {taken[target.resolve()]}; name another file")
        if not target.parent.is_dir():
            raise OutputConflict(f"--{option} {target}: no folder {target.parent}; create it, or name another file")
        if option == "mcap" and target.exists() and not args.force:  # it may be the only copy of a live recording
            raise OutputConflict(f"--mcap {target} exists already; name another file, or replace it with --force")
        taken[target.resolve()] = f"also the output of --{option}"


@contextmanager
def _stoppable() -> Iterator[None]:
    """Let SIGTERM end the command as Ctrl-C does, so that no partial file stays."""

    def stop(number: int, _: object) -> None:
        sys.exit(128 + number)

    if threading.current_thread() is not threading.main_thread():  # only the main thread may set a signal handler
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


@contextmanager
def _replaced_on_success(path: Path) -> Iterator[Path]:
    """A temporary path in the same folder, which replaces ``path`` on success."""
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _run(source: RecordingSource, translator: Translator | None, file: McapFile | None) -> str:
    """Replay; returns why it ended early, empty where it did not."""
    due, begun = FIRST_MAP, time.monotonic()
    shown, every = begun, 1.0 if sys.stderr.isatty() else IN_A_LOG_S
    try:
        for frame in source.frames(raw=file is not None):
            if translator is None or file is None:
                continue
            for out in translator.convert(frame):
                file.write(out)
            if source.rerun.ledger.keyframes >= due:
                due = int(GROWTH * source.rerun.ledger.keyframes) + 1
                _draw(source, translator, file)
            if time.monotonic() - shown > every:
                shown = time.monotonic()
                _say(progress(source.source.done, source.source.total, shown - begun))
    except HalError as error:
        return str(error)
    finally:
        if sys.stderr.isatty():
            _say("")
    return ""


def progress(done: int, total: int, seconds: float) -> str:
    """Progress text: share done, and the time left at the present rate."""
    share = done / max(1, total)
    if share < 0.01:  # too early for a rate
        return "export: 0 %"
    left = seconds * (1.0 - share) / share
    return f"export: {100 * share:.0f} %, {f'{left:.0f} s' if left < 100.0 else f'{left / 60.0:.0f} min'} left"


def _draw(source: RecordingSource, translator: Translator, file: McapFile) -> None:
    grid = source.rerun.render()
    corner = (float(grid.origin[0]), float(grid.origin[1]))
    for out in translator.grid(source.rerun.t_mono, corner, grid.resolution, grid.log_odds):
        file.write(out)


def _say(text: str) -> None:
    sys.stderr.write(f"\r\x1b[K{text}" if sys.stderr.isatty() else f"{text}\n")
    sys.stderr.flush()
