"""Overrides of unverified profile entries: by name, all likely ones together, and never by a misspelt option."""

from __future__ import annotations

from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import PreflightRefused
from profiles.entry import Confidence
from profiles.library import load_modbus_profile, load_profile, profile_names
from profiles.modbus import ModbusProfile
from tdhil.cli.main import main
from tdhil.errors import UsageError
from tdhil.session.overrides import accepted_lines, check_names, doubtful, note, require_accepted

PLAIN = load_modbus_profile("generic/modbus")
NAMES = [name for name, _ in PLAIN.entries()]


def with_confidence(doubts: dict[str, Confidence]) -> ModbusProfile:
    """Return generic/modbus with some less certain entries."""

    def changed(name: str, part: object) -> object:
        if name not in doubts:
            return part
        return part.model_copy(update={"confidence": doubts[name]})  # type: ignore[attr-defined]

    cycle = PLAIN.cycle.model_copy(update={
        name: changed(f"cycle.{name}", part) for name, part in PLAIN.cycle if f"cycle.{name}" in doubts
    })
    top = {name: changed(name, part) for name, part in PLAIN if name in doubts and name != "cycle"}
    parameters = tuple(changed(f"parameters.{one.name}", one) for one in PLAIN.parameters)
    filters = tuple(changed(f"filters.{one.signal}", one) for one in PLAIN.filters)
    echoes = tuple(changed(f"echoes.{one.setpoint}", one) for one in PLAIN.echoes)
    temperatures = tuple(changed(f"temperatures.{number}", one) for number, one in enumerate(PLAIN.temperatures))
    found = {**top, "cycle": changed("cycle", cycle), "parameters": parameters, "filters": filters, "echoes": echoes,
             "temperatures": temperatures}
    return cast(ModbusProfile, PLAIN.model_copy(update=found))


DOUBTS = st.dictionaries(st.sampled_from(NAMES), st.sampled_from(["likely", "unverified"]), max_size=8)
ACCEPTED = st.sets(st.sampled_from([*NAMES, "likely", "cycle", "parameters", "filters", "echoes"]), max_size=6)


@given(doubts=DOUBTS, accepted=ACCEPTED)
def test_only_entries_without_an_override_are_refused(doubts: dict[str, Confidence], accepted: set[str]) -> None:
    profile = with_confidence(doubts)
    assert {name: entry.confidence for name, entry in doubtful(profile)} == doubts
    wanted = {
        name for name, level in doubts.items()
        if name not in accepted and not (level == "likely" and ({"likely", name.split(".")[0]} & accepted))
    }
    refused: set[str] = set()
    try:
        require_accepted(profile, accepted)
    except PreflightRefused as error:
        lines = [line for line in error.what.split("\n") if line.startswith("  ")]
        refused = {line.split()[0] for line in lines}
        # The proposed options are sufficient and name each unverified entry.
        words = error.next_step.split("--accept-unverified ")[1:]
        require_accepted(profile, {*accepted, *(word.split()[0] for word in words)})
    assert refused == wanted
    taken = {line.split()[0] for line in accepted_lines(profile, accepted)}
    assert taken == set(doubts) - wanted


def test_everything_is_named_with_its_source() -> None:
    profile = with_confidence({"watchdog": "unverified", "cycle.speed": "likely"})
    with pytest.raises(PreflightRefused) as caught:
        require_accepted(profile, ())
    text = str(caught.value)
    assert "watchdog (unverified): this project's own map" in text
    assert "cycle.speed (likely)" in text
    assert "--accept-unverified likely --accept-unverified watchdog" in text


@pytest.mark.parametrize(
    ("name", "said"), [("wachdog", "'watchdog'"), ("cycle.sped", "'cycle.speed'"), ("x", "no such")]
)
def test_a_typo_is_no_override(name: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        check_names(PLAIN, [name], "rig.yaml:3")


@pytest.mark.parametrize("name", profile_names())
def test_every_entry_of_every_profile_can_be_named(name: str) -> None:
    profile = load_profile(name)
    check_names(profile, [entry for entry, _ in profile.entries()])
    require_accepted(profile, {"likely", *profile.below("unverified")})
    assert bool(note(profile)) == bool(doubtful(profile))


@pytest.mark.parametrize("short", ["--ye", "--accept-no", "--reset"])
def test_an_abbreviated_option_is_not_accepted(short: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", "--simulate", short]) == 2
    assert short in capsys.readouterr().err
