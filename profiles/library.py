"""Finds profiles: those that ship, by name, and a user's own, by path."""

import difflib
import re
from pathlib import Path

from profiles.errors import DataFileError, Problem
from profiles.schema import CanopenProfile
from profiles.strict_yaml import load_model

_ROOT = Path(__file__).parent
_SUFFIXES = (".yaml", ".yml")


def profile_names() -> tuple[str, ...]:
    """Every profile that ships, as vendor/model."""
    return tuple(sorted(f"{path.parent.name}/{path.stem}" for path in _ROOT.glob("*/*.yaml")))


def profile_path(name_or_path: str) -> Path:
    """The file of a profile; DataFileError, with names that come close, if none ships under that name.

    What ends in .yaml or .yml is a path, anything else a name.
    """
    if name_or_path.endswith(_SUFFIXES):
        return Path(name_or_path)
    names = profile_names()
    if name_or_path in names:
        return _ROOT / f"{name_or_path}.yaml"
    raise DataFileError((Problem("profile", 0, _unknown(name_or_path, names)),))


def load_profile(name_or_path: str) -> CanopenProfile:
    """A profile that ships (``generic/cia402``) or a file of the user's (``./my-drive.yaml``).

    DataFileError with every problem and its line.
    """
    return load_model(profile_path(name_or_path), CanopenProfile)


def eds_path(name_or_path: str) -> Path | None:
    """The EDS that the profile names, beside it; None if it names none, DataFileError if the file isn't there."""
    profile = profile_path(name_or_path)
    name = load_model(profile, CanopenProfile).eds
    if name is None:
        return None
    path = profile.parent / name
    if not path.is_file():
        raise DataFileError((Problem(str(profile), 0, f"eds: no file '{name}' beside this profile"),))
    return path


def _unknown(name: str, names: tuple[str, ...]) -> str:
    shown = re.sub(r"\s+", " ", name)[:60]
    close = difflib.get_close_matches(name[:80], names, n=3, cutoff=0.5)
    # People type the model without its vendor.
    close += [known for known in names if known.split("/")[1] == name and known not in close]
    meant = " or ".join(f"'{item}'" for item in close)
    known = f"did you mean {meant}?" if close else f"these ship: {', '.join(names)}."
    return f"none named '{shown}'; {known} A file of your own is named by its path, ending in .yaml"
