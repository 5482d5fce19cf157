"""Text files of image names."""

from __future__ import annotations

from pathlib import Path

from colmap_refract.errors import RefractError, reason_of


def _read_lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = "it is no text" if isinstance(error, UnicodeDecodeError) else reason_of(error)
        raise RefractError(f"{path} cannot be read ({reason}); give a text file") from None
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def read_names(path: Path | None) -> list[str]:
    return [] if path is None else _read_lines(path)


def read_groups(path: Path | None) -> dict[str, str]:
    groups: dict[str, str] = {}
    for line in [] if path is None else _read_lines(path):
        name, _, group = line.rpartition(" ")
        name = name.strip()
        if not name:
            raise RefractError(f"{path}: '{line}' is not a line `IMAGE_NAME GROUP`")
        if groups.get(name, group) != group:
            raise RefractError(f"{path}: image '{name}' is in two groups, '{groups[name]}' and '{group}'")
        groups[name] = group
    return groups
