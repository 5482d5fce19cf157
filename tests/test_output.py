"""A model appears in the output folder whole or not at all, and what is not ours stays."""

from __future__ import annotations

import errno
import os
from functools import partial
from pathlib import Path

import pytest
from conftest import error_of, snapshot

from colmap_refract.errors import RefractError
from colmap_refract.files.output import WORK_PREFIX, output_folder


def fill(folder: Path) -> None:
    (folder / "cameras.bin").write_bytes(b"new")
    (folder / "refraction.json").write_bytes(b"new sidecar")


def write_to(path: Path, overwrite: bool = False, input_path: Path | None = None) -> None:
    with output_folder(path, input_path=input_path, overwrite=overwrite) as folder:
        assert not list(folder.iterdir())
        fill(folder)


NEW = {"cameras.bin": b"new", "refraction.json": b"new sidecar"}
OLD = {
    "cameras.bin": b"old",
    "rigs.bin": b"old rigs",
    "images.txt": b"stale",
    "refraction.json": b"old sidecar",
    "notes.txt": b"foreign",
    "images/1.png": b"foreign too",
}
FOREIGN = {"notes.txt": b"foreign", "images/1.png": b"foreign too"}


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """An earlier output, with files of the user among it."""
    folder = tmp_path / "out"
    for name, data in OLD.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def test_new_folder(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "out"
    write_to(path)
    assert snapshot(tmp_path) == {f"a/b/out/{name}": data for name, data in NEW.items()}
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o777 & ~umask


def test_empty_folder(tmp_path: Path) -> None:
    write_to(tmp_path)
    assert snapshot(tmp_path) == NEW


def test_nothing_is_visible_before_the_end(tmp_path: Path, old: Path) -> None:
    with output_folder(tmp_path / "new", input_path=None, overwrite=False) as folder:
        fill(folder)
        assert not (tmp_path / "new").exists()
    with output_folder(old, input_path=None, overwrite=True) as folder:
        fill(folder)
        assert {name: (old / name).read_bytes() for name in OLD} == OLD


def test_existing_model_needs_overwrite(old: Path) -> None:
    assert "is not empty" in error_of(lambda: write_to(old))
    assert snapshot(old) == OLD


def test_overwrite_keeps_foreign_files_and_drops_stale_ones(old: Path) -> None:
    write_to(old, overwrite=True)
    assert snapshot(old) == NEW | FOREIGN
    write_to(old, overwrite=True)
    assert snapshot(old) == NEW | FOREIGN


@pytest.mark.parametrize("exception", [ValueError, KeyboardInterrupt, SystemExit, RefractError])
@pytest.mark.parametrize("exists", [True, False])
def test_exception_in_the_block_leaves_everything(
    tmp_path: Path, old: Path, exception: type[BaseException], exists: bool
) -> None:
    path = old if exists else tmp_path / "a" / "b"
    with pytest.raises(exception), output_folder(path, input_path=None, overwrite=True) as folder:
        fill(folder)
        raise exception("stop")
    assert snapshot(tmp_path) == {f"out/{name}": data for name, data in OLD.items()}
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("exception", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
@pytest.mark.parametrize("call", range(6))
def test_failing_exchange_puts_everything_back(
    tmp_path: Path, old: Path, monkeypatch: pytest.MonkeyPatch, exception: BaseException, call: int
) -> None:
    replace, calls = os.replace, iter(range(100))

    def fail_once(source: Path, destination: Path) -> None:
        if next(calls) == call:
            raise exception
        replace(source, destination)

    monkeypatch.setattr(os, "replace", fail_once)
    expected = KeyboardInterrupt if isinstance(exception, KeyboardInterrupt) else RefractError
    with pytest.raises(expected):
        write_to(old, overwrite=True)
    assert next(calls) > call
    assert snapshot(tmp_path) == {f"out/{name}": data for name, data in OLD.items()}
    assert sorted(p.name for p in old.iterdir()) == sorted({name.split("/")[0] for name in OLD})


def test_what_cannot_be_put_back_is_kept(tmp_path: Path, old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace, calls = os.replace, iter(range(100))

    def fail(source: Path, destination: Path) -> None:
        if next(calls) >= 2:
            raise OSError(errno.EIO, "Input/output error")
        replace(source, destination)

    monkeypatch.setattr(os, "replace", fail)
    error_of(lambda: write_to(old, overwrite=True))
    assert sorted(snapshot(old).values()) == sorted(OLD.values())


def test_output_is_the_input(tmp_path: Path, old: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(old, target_is_directory=True)
    for path in (old, link, old / ".." / "out", old / "images" / ".."):
        assert "is the input" in error_of(partial(write_to, path, overwrite=True, input_path=old))
        assert "is the input" in error_of(partial(write_to, old, overwrite=True, input_path=path))
    assert snapshot(old) == OLD


def test_output_inside_and_around_the_input(tmp_path: Path) -> None:
    source = tmp_path / "sparse" / "0"
    source.mkdir(parents=True)
    (source / "cameras.bin").write_bytes(b"input")
    write_to(source / "refined", input_path=source)
    assert snapshot(source) == {"cameras.bin": b"input"} | {f"refined/{name}": data for name, data in NEW.items()}
    write_to(tmp_path / "sparse", overwrite=True, input_path=source)
    assert (source / "cameras.bin").read_bytes() == b"input"


def test_output_through_a_link(tmp_path: Path, old: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(old, target_is_directory=True)
    write_to(link, overwrite=True)
    assert link.is_symlink() and snapshot(old) == NEW | FOREIGN


def test_output_is_a_file(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    assert "is a file" in error_of(lambda: write_to(file, overwrite=True))
    assert "cannot write" in error_of(lambda: write_to(file / "below", overwrite=True))
    assert snapshot(tmp_path) == {"file": b"x"}


def test_folder_in_the_place_of_a_file(old: Path) -> None:
    (old / "points3D.bin").mkdir()
    assert "points3D.bin is a folder" in error_of(lambda: write_to(old, overwrite=True))
    assert snapshot(old) == OLD


def test_other_files_than_a_models(old: Path) -> None:
    """What goes is what the caller names; a folder replaces the one of its name with all that is in it."""
    with output_folder(old, input_path=None, overwrite=True, own_files=("notes.txt", "images")) as folder:
        (folder / "images").mkdir()
        (folder / "images" / "2.png").write_bytes(b"new")
    left = {name: data for name, data in OLD.items() if name not in FOREIGN}
    assert snapshot(old) == left | {"images/2.png": b"new"}


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENOSPC])
def test_unwritable_parent(
    tmp_path: Path, old: Path, monkeypatch: pytest.MonkeyPatch, exists: bool, number: int
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "mkdir", refuse)
    path = old if exists else tmp_path / "new"
    message = error_of(lambda: write_to(path, overwrite=True))
    assert message.startswith(f"cannot write to {path}: {os.strerror(number)}")


def test_disk_errors_in_the_block(old: Path) -> None:
    def write(error: OSError) -> None:
        with output_folder(old, input_path=None, overwrite=True) as folder:
            if error.filename:
                error.filename = str(folder / error.filename)
            raise error

    assert "No space left" in error_of(lambda: write(OSError(errno.ENOSPC, "No space left on device")))
    assert "Permission" in error_of(lambda: write(PermissionError(errno.EACCES, "Permission denied", "x.json")))
    with pytest.raises(FileNotFoundError):
        write(FileNotFoundError(errno.ENOENT, "No such file"))
    assert snapshot(old) == OLD


def test_disk_that_reports_only_on_sync(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert "No space left" in error_of(lambda: write_to(old, overwrite=True))
    assert snapshot(old) == OLD


def test_leftovers_of_a_killed_run_do_not_count(tmp_path: Path) -> None:
    (tmp_path / f"{WORK_PREFIX}0123").mkdir()
    write_to(tmp_path)
    assert snapshot(tmp_path) == NEW
