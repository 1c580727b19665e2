"""Search for profiles: by name for those that tdhil contains, by path for the user's own."""

import difflib
import re
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict

from profiles.canopen import CanopenProfile
from profiles.errors import DataFileError, Problem
from profiles.ethercat import EthercatProfile
from profiles.messages import MessageCode
from profiles.modbus import ModbusProfile
from profiles.model import DataModel, one_of
from profiles.yaml_loader import parse_model, read_text

Profile = CanopenProfile | EthercatProfile | ModbusProfile

_ROOT = Path(__file__).parent
_SUFFIXES = (".yaml", ".yml")
SCHEMAS: dict[str, type[Profile]] = {
    "canopen": CanopenProfile, "ethercat": EthercatProfile, "modbus": ModbusProfile,
}
"""Schema of a profile, by its bus."""


_BUS = re.compile(r"^bus: *(\w+) *(?:#.*)?$", re.MULTILINE)


def _known_bus(value: Any) -> Any:
    return one_of(tuple(SCHEMAS), value)


class _Head(DataModel):
    """The key that selects the schema of the other keys."""

    model_config = ConfigDict(extra="ignore")

    bus: Annotated[str, BeforeValidator(_known_bus)]


def profile_names() -> tuple[str, ...]:
    """Return the names of all profiles that tdhil contains, as vendor/model."""
    return tuple(sorted(f"{path.parent.name}/{path.stem}" for path in _ROOT.glob("*/*.yaml")))


def matching_names(text: str) -> tuple[str, ...]:
    """Return the names of profiles that tdhil contains and that ``text`` abbreviates, without regard to case.

    ``text`` may be a vendor, or the beginning of a name with or without its vendor. ``abb`` gives all of ABB's,
    ``abb/acs880`` or ``acs880`` two of them; a whole name gives itself alone.
    """
    asked, names = text.strip().lower(), profile_names()
    if not asked or asked in names:
        return (asked,) if asked else ()
    ways = (
        [name for name in names if name.partition("/")[0] == asked.rstrip("/")],
        [name for name in names if name.startswith(asked)],
        [name for name in names if name.partition("/")[2].startswith(asked)],
    )
    return tuple(next((found for found in ways if found), []))


def profile_path(name_or_path: str) -> Path:
    """Return the file of a profile. Raises DataFileError, with similar names, if tdhil contains no profile of that
    name.

    A text that ends in .yaml or .yml is a path; any other text is a name.
    """
    if name_or_path.endswith(_SUFFIXES):
        return Path(name_or_path)
    names = profile_names()
    if name_or_path in names:
        return _ROOT / f"{name_or_path}.yaml"
    raise DataFileError((Problem("profile", 0, _unknown(name_or_path, names)),), entry=MessageCode.PROFILE_UNKNOWN)


def load_profile(name_or_path: str, bus: str | None = None) -> Profile:
    """Return a profile that tdhil contains (``generic/cia402``) or a user's file (``./my-drive.yaml``), for ``bus`` if
    given.

    Raises DataFileError with every problem and its line, and for a profile of another bus.
    """
    path = profile_path(name_or_path)
    profile = _parsed(read_text(path), str(path))
    if bus is not None and profile.bus != bus:
        raise DataFileError((Problem(name_or_path, 0, f"is a profile for {profile.bus}, and --drive says {bus}"),),
                            entry=MessageCode.PROFILE_OTHER_BUS)
    return profile


def profile_text(name_or_path: str) -> str:
    """Return the text of the file that `load_profile` reads. Raises DataFileError if it can't be read."""
    return read_text(profile_path(name_or_path))


def parse_profile(text: str, name: str) -> Profile:
    """Return a profile from its text; messages call it ``name``. Raises DataFileError with every problem
    and its line.
    """
    return _parsed(text, name)


@lru_cache(maxsize=64)
def _parsed(text: str, name: str) -> Profile:
    """Parse a text once: the result is frozen, and a scan or a table needs all profiles."""
    # One plain line of the text names the bus. The schema of this bus checks the key again.
    stated = _BUS.findall(text)
    plain = len(stated) == 1 and stated[0] in SCHEMAS
    return parse_model(text, name, SCHEMAS[stated[0] if plain else parse_model(text, name, _Head).bus])


def load_canopen_profile(name_or_path: str) -> CanopenProfile:
    """Return a CANopen profile like `load_profile`. Raises DataFileError for a profile of another bus."""
    profile = load_profile(name_or_path, "canopen")
    assert isinstance(profile, CanopenProfile)
    return profile


def load_ethercat_profile(name_or_path: str) -> EthercatProfile:
    """Return an EtherCAT profile like `load_profile`. Raises DataFileError for a profile of another bus."""
    profile = load_profile(name_or_path, "ethercat")
    assert isinstance(profile, EthercatProfile)
    return profile


def load_modbus_profile(name_or_path: str) -> ModbusProfile:
    """Return a Modbus profile like `load_profile`. Raises DataFileError for a profile of another bus."""
    profile = load_profile(name_or_path, "modbus")
    assert isinstance(profile, ModbusProfile)
    return profile


def eds_path(name_or_path: str) -> Path | None:
    """Return the EDS that the profile names, in the same folder; None if it names none. Raises DataFileError if it is
    missing.
    """
    profile = load_profile(name_or_path)
    if not isinstance(profile, CanopenProfile) or profile.eds is None:
        return None
    file = profile_path(name_or_path)
    path = file.parent / profile.eds
    if not path.is_file():
        raise DataFileError((Problem(str(file), 0, f"eds: no file '{profile.eds}' beside this profile"),))
    return path


def _unknown(name: str, names: tuple[str, ...]) -> str:
    shown = re.sub(r"\s+", " ", name)[:60]
    # Users type the vendor alone, or the model without its vendor, or misspell one of them.
    close = list(matching_names(name[:80])) or difflib.get_close_matches(name[:80], names, n=3, cutoff=0.5)
    if not close:
        parts = {part: known for known in reversed(names) for part in known.split("/")}
        close = [parts[part] for part in difflib.get_close_matches(name[:80].lower(), parts, n=2, cutoff=0.6)]
    meant = " or ".join(f"'{item}'" for item in close)
    makes = dict.fromkeys(one.partition("/")[0] for one in names)
    known = f"did you mean {meant}?" if close else f"profiles ship for {', '.join(makes)}."
    return f"none named '{shown}'; {known} A file of your own is named by its path, ending in .yaml"
