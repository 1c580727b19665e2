"""Settings of a run: rig.yaml, and every option with the source of its value."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.config.keywords import (
        OF_THE_RESULT as OF_THE_RESULT, OF_THE_RUN as OF_THE_RUN, OF_THE_SIMULATOR as OF_THE_SIMULATOR,
        values_of as values_of, with_keywords as with_keywords,
    )
    from tdhil.config.options import (
        ASKED_AGAIN as ASKED_AGAIN, CLOCKS as CLOCKS, EvidenceOptions as EvidenceOptions,
        OF_A_TRACE as OF_A_TRACE, OF_EVIDENCE as OF_EVIDENCE, OF_THE_HEAD as OF_THE_HEAD, OPTION as OPTION,
        OPTIONS as OPTIONS, PUBLISHABLE as PUBLISHABLE, Topic as Topic, Option as Option,
        Origin as Origin, Overrides as Overrides, RunDetails as RunDetails, RunOptions as RunOptions,
        STATED as STATED, Setting as Setting, form_options as form_options,
    )
    from tdhil.config.registry import (
        BUSES as BUSES, DEFAULT_BUS as DEFAULT_BUS, DEFAULT_EXCITATION as DEFAULT_EXCITATION,
        EXCITATIONS as EXCITATIONS, MODELS as MODELS, SPEED_UNIT_TOLERANCE as SPEED_UNIT_TOLERANCE,
        USUAL_STAGE_S as USUAL_STAGE_S, has_plateaus as has_plateaus, imported as imported, load as load,
        identified_before_echo as identified_before_echo,
    )
    from tdhil.config.acceptance import (
        ACCEPTED_QUANTITIES as ACCEPTED_QUANTITIES, Expectation as Expectation, expectations_in as expectations_in,
        expectations_of as expectations_of,
    )
    from tdhil.config.resolution import (
        check_values as check_values, resolve as resolve, wrong_values as wrong_values,
    )
    from tdhil.config.rig import (
        LONGEST_NAME as LONGEST_NAME, DriveData as DriveData, Limits as Limits, Registered as Registered, Rig as Rig,
        limits_step as limits_step, load_rig as load_rig, parse_rig as parse_rig,
        require_limits as require_limits, require_name as require_name,
        rig_model as rig_model, simulated_default_rig as simulated_default_rig,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "keywords": "OF_THE_RESULT OF_THE_RUN OF_THE_SIMULATOR values_of with_keywords",
        "options": "ASKED_AGAIN CLOCKS EvidenceOptions OF_A_TRACE OF_EVIDENCE OF_THE_HEAD OPTION OPTIONS "
                   "PUBLISHABLE Topic Option Origin Overrides RunDetails RunOptions STATED Setting form_options",
        "registry": "BUSES DEFAULT_BUS DEFAULT_EXCITATION EXCITATIONS MODELS SPEED_UNIT_TOLERANCE USUAL_STAGE_S "
                    "has_plateaus imported load identified_before_echo",
        "acceptance": "ACCEPTED_QUANTITIES Expectation expectations_in expectations_of",
        "resolution": "check_values resolve wrong_values",
        "rig": "LONGEST_NAME DriveData Limits Registered Rig limits_step load_rig parse_rig require_limits "
               "require_name rig_model simulated_default_rig",
    })
