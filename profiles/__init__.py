"""Drive profiles as data: the schemas, a strict YAML loader, and the profiles that tdhil contains."""

from typing import TYPE_CHECKING

from profiles.lazy import lazy_names as lazy_names

if TYPE_CHECKING:
    from profiles.eds_import import begin_profile as begin_profile
    from profiles.eds_reader import read_eds as read_eds
    from profiles.entry import (
        Confidence as Confidence, DriveProfile as DriveProfile, ProfileEntry as ProfileEntry, Require as Require,
        CONTROLLER_UNITS as CONTROLLER_UNITS, NotchParameter as NotchParameter,
        SpeedControllerParameters as SpeedControllerParameters,
        unit_text as unit_text, with_unit as with_unit,
    )
    from profiles.errors import (
        DataFileError as DataFileError, Problem as Problem, TdhilError as TdhilError, UsageError as UsageError,
    )
    from profiles.library import (
        Profile as Profile, eds_path as eds_path, load_canopen_profile as load_canopen_profile,
        load_ethercat_profile as load_ethercat_profile, load_modbus_profile as load_modbus_profile,
        load_profile as load_profile, matching_names as matching_names,
        parse_profile as parse_profile, profile_names as profile_names, profile_text as profile_text,
    )
    from profiles.messages import (
        CodedText as CodedText, MessageCode as MessageCode, entry_of as entry_of, message_of as message_of,
        with_code as with_code,
    )
    from profiles.model import (
        DataModel as DataModel, Finding as Finding, NonNegative as NonNegative, Positive as Positive,
        Validated as Validated, one_of as one_of, refuse_if as refuse_if,
    )
    from profiles.simulator_marker import (
        CYCLES_END as CYCLES_END, CYCLE_ANSWER as CYCLE_ANSWER, CYCLE_ASKED as CYCLE_ASKED, CYCLE_ID as CYCLE_ID,
        CYCLE_OVER as CYCLE_OVER, LAST_CYCLE_OVER as LAST_CYCLE_OVER, MARKER_INDEX as MARKER_INDEX,
        MARKER_REGISTER as MARKER_REGISTER, MARKER_REGISTERS as MARKER_REGISTERS, MARKER_STAGE as MARKER_STAGE,
        MARKER_STAGE_REGISTER as MARKER_STAGE_REGISTER, MARKER_TEXT as MARKER_TEXT, STAGE_NUMBERS as STAGE_NUMBERS,
    )
    from profiles.visible_text import visible as visible
    from profiles.yaml_loader import (
        Conversion as Conversion, Loaded as Loaded, load_model as load_model, load_with_lines as load_with_lines,
        messages_of as messages_of, parse_model as parse_model, parse_with_lines as parse_with_lines,
    )
    from profiles.yaml_tree import read_tree as read_tree
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "eds_import": "begin_profile",
        "eds_reader": "read_eds",
        "entry": "CONTROLLER_UNITS Confidence DriveProfile NotchParameter ProfileEntry Require "
                 "SpeedControllerParameters unit_text with_unit",
        "errors": "DataFileError Problem TdhilError UsageError",
        "library": "Profile eds_path load_canopen_profile load_ethercat_profile load_modbus_profile load_profile "
                   "matching_names parse_profile profile_names profile_text",
        "messages": "CodedText MessageCode entry_of message_of with_code",
        "model": "DataModel Finding NonNegative Positive Validated one_of refuse_if",
        "simulator_marker": "CYCLES_END CYCLE_ANSWER CYCLE_ASKED CYCLE_ID CYCLE_OVER LAST_CYCLE_OVER MARKER_INDEX "
                            "MARKER_REGISTER MARKER_REGISTERS MARKER_STAGE MARKER_STAGE_REGISTER MARKER_TEXT "
                            "STAGE_NUMBERS",
        "visible_text": "visible",
        "yaml_loader": "Conversion Loaded load_model load_with_lines messages_of parse_model parse_with_lines",
        "yaml_tree": "read_tree",
    })
