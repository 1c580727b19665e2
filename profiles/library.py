"""Finds profiles: those that ship, by name, and a user's own, by path."""

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
SCHEMAS: dict[str, type[CanopenProfile] | type[EthercatProfile] | type[ModbusProfile]] = {
    "canopen": CanopenProfile, "ethercat": EthercatProfile, "modbus": ModbusProfile,
}
"""Schema of a profile, by its bus."""


def _known_bus(value: Any) -> Any:
    return one_of(tuple(SCHEMAS), value)


class _Head(DataModel):
    """The key that says which schema the rest follows."""

    model_config = ConfigDict(extra="ignore")

    bus: Annotated[str, BeforeValidator(_known_bus)]


def profile_names() -> tuple[str, ...]:
    """Every profile that ships, as vendor/model."""
    return tuple(sorted(f"{path.parent.name}/{path.stem}" for path in _ROOT.glob("*/*.yaml")))


def matching_names(text: str) -> tuple[str, ...]:
    """Those that ship and that ``text`` may be short for: a vendor's all, else what begins so; capitals don't count.

    ``abb`` is all of ABB's, ``abb/acs880`` or ``acs880`` two of them; a whole name is itself alone.
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
    """The file of a profile; DataFileError, with names that come close, if none ships under that name.

    What ends in .yaml or .yml is a path, anything else a name.
    """
    if name_or_path.endswith(_SUFFIXES):
        return Path(name_or_path)
    names = profile_names()
    if name_or_path in names:
        return _ROOT / f"{name_or_path}.yaml"
    raise DataFileError((Problem("profile", 0, _unknown(name_or_path, names)),), entry=MessageCode.PROFILE_UNKNOWN)


def load_profile(name_or_path: str, bus: str | None = None) -> Profile:
    """A profile that ships (``generic/cia402``) or a file of the user's (``./my-drive.yaml``), of any bus or of this.

    DataFileError with every problem and its line, and for a profile of another bus.
    """
    path = profile_path(name_or_path)
    profile = _parsed(read_text(path), str(path))
    if bus is not None and profile.bus != bus:
        raise DataFileError((Problem(name_or_path, 0, f"is a profile for {profile.bus}, and --drive says {bus}"),),
                            entry=MessageCode.PROFILE_OTHER_BUS)
    return profile


def profile_text(name_or_path: str) -> str:
    """The text of the file that `load_profile` reads. DataFileError where it can't be read."""
    return read_text(profile_path(name_or_path))


def parse_profile(text: str, name: str) -> Profile:
    """A profile from its text; ``name`` stands in messages. DataFileError with every problem and its line."""
    return _parsed(text, name)


@lru_cache(maxsize=64)
def _parsed(text: str, name: str) -> Profile:
    """The same text is parsed once: what comes of it is frozen, and a scan or a table asks for all of them."""
    return parse_model(text, name, SCHEMAS[parse_model(text, name, _Head).bus])


def load_canopen_profile(name_or_path: str) -> CanopenProfile:
    """Do the same as `load_profile`; DataFileError for a profile of another bus."""
    profile = load_profile(name_or_path, "canopen")
    assert isinstance(profile, CanopenProfile)
    return profile


def load_modbus_profile(name_or_path: str) -> ModbusProfile:
    """Do the same as `load_profile`; DataFileError for a profile of another bus."""
    profile = load_profile(name_or_path, "modbus")
    assert isinstance(profile, ModbusProfile)
    return profile


def eds_path(name_or_path: str) -> Path | None:
    """The EDS that the profile names, beside it; None if it names none, DataFileError if the file isn't there."""
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
    # People type the vendor alone, or the model without its vendor; or one of them wrongly.
    close = list(matching_names(name[:80])) or difflib.get_close_matches(name[:80], names, n=3, cutoff=0.5)
    if not close:
        parts = {part: known for known in reversed(names) for part in known.split("/")}
        close = [parts[part] for part in difflib.get_close_matches(name[:80].lower(), parts, n=2, cutoff=0.6)]
    meant = " or ".join(f"'{item}'" for item in close)
    makes = dict.fromkeys(one.partition("/")[0] for one in names)
    known = f"did you mean {meant}?" if close else f"profiles ship for {', '.join(makes)}."
    return f"none named '{shown}'; {known} A file of your own is named by its path, ending in .yaml"
