"""COLMAP in a process of its own.

A stage of COLMAP may take hours in which it listens to nobody, write to the terminal, or abort the whole process when
a disk is full. In a process of its own it can be ended at any moment (its database survives that, as transactions do),
its log goes to a file, and its end is an error message. Nor may a process that has a database open in COLMAP's own
SQLite look into it through Python's, since each of the two drops the locks of the other.
"""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from queue import Empty, Queue
from typing import Any

from colmap_refract.errors import RefractError

_POLL_SECONDS = 0.25
_NEXT_TO_NO_ROOM = 1 << 20
"""Bytes."""
_FULL_DISK = ("disk is full", "No space left", "disk I/O error", "File too large")


def run_colmap(
    function: str,
    arguments: dict[str, Any],
    *,
    log_path: Path,
    what: str,
    watch: Callable[[dict[str, Any]], None] | None = None,
    poll: Callable[[], None] | None = None,
) -> None:
    """Run one of `FUNCTIONS` in a new process, and wait for it.

    Args:
        function: name in `FUNCTIONS`.
        arguments: keyword arguments of it; they are pickled.
        log_path: file that COLMAP's log is added to.
        what: for messages, e.g. 'feature extraction'.
        watch: called with every message of the function.
        poll: called several times a second.

    Raises:
        RefractError: the function failed, or its process was killed.
        KeyboardInterrupt: as anything else that comes up while waiting, after the process has been ended.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        log = log_path.open("ab")
    except OSError as error:
        raise RefractError(f"cannot write {log_path}: {error.strerror}; give another workspace") from error
    with log:
        process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env=environment,
        )
        try:
            failure = _wait(process, pickle.dumps((function, arguments)), watch, poll)
        finally:
            process.kill()
            process.wait()
            _settle(arguments.get("database_path"))
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
    if failure is None and process.returncode == 0:
        return
    if failure is None:
        number = -process.returncode
        name = signal.Signals(number).name if number in set(signal.Signals) else f"status {process.returncode}"
        hint = "is there enough memory? fewer --num_threads need less" if name == "SIGKILL" else f"see {log_path}"
        failure = f"its process ended with {name}; {hint}"
    if any(sign in failure + _tail(log_path) for sign in _FULL_DISK) or _is_full(log_path.parent, arguments):
        failure = "the disk is full, or the file may not grow further; make room, and run it again"
    raise RefractError(f"COLMAP's {what} failed: {failure}")


def _is_full(folder: Path, arguments: dict[str, Any]) -> bool:
    """Whether a disk that was written to has next to no room left: COLMAP may abort without a word then."""
    written = [Path(arguments[name]).parent for name in ("database_path", "output_path") if name in arguments]
    for place in (folder, *written):
        with suppress(OSError):
            if shutil.disk_usage(place).free < _NEXT_TO_NO_ROOM:
                return True
    return False


def _settle(path: Path | None) -> None:
    """Bring into a database what a process that was ended has left in files beside it."""
    if path is None or not os.path.exists(f"{path}-wal"):
        return
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=rw", uri=True)) as database:
        database.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()  # it is closed as it was if never read


def _wait(
    process: subprocess.Popen[bytes],
    work: bytes,
    watch: Callable[[dict[str, Any]], None] | None,
    poll: Callable[[], None] | None,
) -> str | None:
    """The function's own account of its failure, or None; the process is over, or about to be."""
    assert process.stdin is not None and process.stdout is not None
    messages: Queue[dict[str, Any] | None] = Queue()
    stdout = process.stdout

    def listen() -> None:
        for line in stdout:
            try:
                message = json.loads(line)
            except ValueError:
                continue
            if isinstance(message, dict):  # what else there is, a library has printed
                messages.put(message)
        messages.put(None)

    threading.Thread(target=listen, daemon=True).start()
    try:
        process.stdin.write(len(work).to_bytes(8, "little") + work)
        process.stdin.flush()  # and stays open: its end tells the process that we are gone
    except BrokenPipeError:
        pass  # it died; its status says more
    while True:
        try:
            message = messages.get(timeout=_POLL_SECONDS)
        except Empty:
            if poll is not None:
                poll()
            continue
        if message is None:
            process.wait()
            return None
        if "error" in message:
            return str(message["error"])
        if watch is not None:
            watch(message)


def _tail(path: Path) -> str:
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - 2000))
            return file.read().decode(errors="replace")
    except OSError:
        return ""


# --- In the other process --------------------------------------------------------------------------------------------


def _say(**message: Any) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def _add_images(database_path: Path, image_path: Path, groups: list[tuple[Any, ...]]) -> None:
    """Groups are (names, camera, id of that camera in the database or None)."""
    import pycolmap

    for names, camera, camera_id in groups:
        with pycolmap.Database.open(database_path) as database:
            if camera_id is None:
                camera_id = database.write_camera(camera)
        reader = pycolmap.ImageReaderOptions(existing_camera_id=camera_id)
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database_path, image_path, camera_mode=mode, image_names=names, options=reader)
        with pycolmap.Database.open(database_path) as database:
            lacking = [name for name in names if not database.exists_image(name)]
        if lacking:
            raise RuntimeError(f"it does not read image '{lacking[0]}'; remove or replace it")


def _extract(database_path: Path, image_path: Path, names: list[str], options: Any) -> None:
    import pycolmap

    pycolmap.extract_features(database_path, image_path, image_names=names, extraction_options=options)


def _match(
    database_path: Path, sequential: bool, matching_options: Any, pairing_options: Any, verification_options: Any
) -> None:
    import pycolmap

    generator = pycolmap.SequentialPairGenerator if sequential else pycolmap.ExhaustivePairGenerator
    if not (sequential and pairing_options.loop_detection):  # looking images up takes its time
        with pycolmap.Database.open(database_path) as database:
            pairs = generator(pairing_options, database).all_pairs()
        _say(pairs=len({tuple(sorted(pair)) for pair in pairs}))
    match = pycolmap.match_sequential if sequential else pycolmap.match_exhaustive
    match(
        database_path,
        matching_options=matching_options,
        pairing_options=pairing_options,
        verification_options=verification_options,
    )


def _map(database_path: Path, image_path: Path, output_path: Path, options: Any) -> None:
    import pycolmap

    pycolmap.incremental_mapping(
        database_path,
        image_path,
        output_path,
        options,
        initial_image_pair_callback=lambda: _say(new_images=2, new_model=True),
        next_image_callback=lambda: _say(new_images=1),
    )


def _mesh(input_path: Path, output_path: Path, options: dict[str, Any]) -> None:
    import pycolmap

    pycolmap.poisson_meshing(input_path, output_path, pycolmap.PoissonMeshingOptions(options))


FUNCTIONS: dict[str, Callable[..., None]] = {
    "add_images": _add_images,
    "extract": _extract,
    "match": _match,
    "map": _map,
    "mesh": _mesh,
}


def main() -> None:
    """Do what standard input asks for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both; whoever waits for us decides
    source = sys.stdin.buffer
    size = int.from_bytes(source.read(8), "little")
    function, arguments = pickle.loads(source.read(size))

    def leave_with_parent() -> None:
        source.read()
        os._exit(1)

    threading.Thread(target=leave_with_parent, daemon=True).start()
    try:
        FUNCTIONS[function](**arguments)
    except Exception as error:
        # Without the place in COLMAP's source that it begins with.
        reason = re.sub(r"^\[\S+:\d+\] ", "", " ".join(str(error).split()))[:200]
        _say(error=reason or type(error).__name__)
        os._exit(1)
    sys.stdout.flush()
    # No farewell: libraries that tidy up at the end may wait for threads of theirs.
    os._exit(0)


if __name__ == "__main__":
    main()
