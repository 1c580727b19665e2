"""Shipped profiles, and profiles of the user."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from profiles.canopen import CanopenProfile
from profiles.errors import DataFileError
from profiles.library import SCHEMAS, eds_path, load_profile, profile_names, profile_path

GENERIC = Path(profile_path("generic/cia402")).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", profile_names())
def test_every_profile_that_ships_loads_under_its_own_name(name: str) -> None:
    assert load_profile(name).name == name
    eds_path(name)


@pytest.mark.parametrize("name", profile_names())
def test_every_profile_that_ships_has_its_row_on_the_page(name: str) -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference" / "profiles.md").read_text(encoding="utf-8")
    rows = [line.split(" | ")[0] for line in text.split("## What ships")[1].splitlines() if line.startswith("| `")]
    assert f"| `{name}`" in rows


def test_generic_contains_the_entries_that_the_driver_needs() -> None:
    profile = load_profile("generic/cia402")
    assert profile.modes.speed == (9, 3)
    assert profile.modes.torque == (10, 4)
    assert profile.speed.rpm_per_lsb == 0.1
    assert profile.torque.rated_torque_nm_per_lsb == 0.001
    assert (profile.watchdog.consumer_index, profile.watchdog.reaction_index) == (0x1016, 0x6007)
    assert profile.watchdog.reaction_value == 3
    assert profile.quick_stop.option_code == 6
    assert profile.identity.vendor is None
    assert not profile.below("unverified")


def test_profiles_are_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        load_profile("generic/cia402").node = 2


@pytest.mark.parametrize("name", ["cia402", "generic/cia401", "Generic/cia402"])
def test_unknown_name_lists_similar_names(name: str) -> None:
    with pytest.raises(DataFileError, match="did you mean 'generic/cia402'"):
        load_profile(name)


@pytest.mark.parametrize("name", ["", "../../etc/passwd", "generic", "a\nb", "x" * 5000])
def test_names_access_no_other_file(name: str) -> None:
    with pytest.raises(DataFileError) as caught:
        load_profile(name)
    assert len(str(caught.value)) < 500


def test_a_copy_of_generic_is_a_valid_profile(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(GENERIC.replace("generic/cia402", "mine/drive").replace("product: null", "product: 0x6552_0000"))
    with pytest.raises(DataFileError, match=r"mine\.yaml:\d+: identity\.product: must be a whole number"):
        load_profile(str(path))
    path.write_text(GENERIC.replace("generic/cia402", "mine/drive").replace("vendor: null", "vendor: 0xFB"))
    assert load_profile(str(path)).identity.vendor == 0xFB


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("torque: [10, 4]", "torque: [9]", "can't be a speed mode and a torque mode"),
        ("speed: [9, 3]", "speed: []", "at least 1 entries"),
        ("speed: [9, 3]", "speed: [2]", "both or neither"),
        ("  rpm_per_lsb: 0.1\n", "  rpm_per_lsb: 0.1\n  vl: true\n", "both or neither"),
        ("speed: [9, 3]\n", "speed: [2, 3]\n", "both or neither"),
        ("  reaction_value: 3\n", "", "belong together"),
        ("reaction: quick_stop", "reaction: none", "say what the drive does"),
        ("kind: heartbeat", "kind: none", "must be none"),
        ("kind: heartbeat", "kind: heatbeat", "did you mean 'heartbeat'?"),
        ("confidence: verified", "confidence: sure", "must be 'verified', 'likely' or 'unverified', not"),
        ("eds: cia402.eds", "eds: ../x.eds", "plain name"),
        ("rpm_per_lsb: 0.1", "rpm_per_lsb: 0", "greater than 0"),
        ("bus: canopen", "bus: profibus", f"{', '.join(map(repr, [*SCHEMAS][:-1]))} or {[*SCHEMAS][-1]!r}, not"),
    ],
)
def test_wrong_profiles(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in GENERIC
    path = tmp_path / "mine.yaml"
    path.write_text(GENERIC.replace(old, new))
    with pytest.raises(DataFileError) as caught:
        load_profile(str(path))
    assert words in str(caught.value)
    assert all(problem.line for problem in caught.value.problems)


def test_an_eds_that_is_not_there(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(GENERIC.replace("eds: cia402.eds", "eds: mine.eds"))
    with pytest.raises(DataFileError, match=r"no file 'mine\.eds'"):
        eds_path(str(path))
    (tmp_path / "mine.eds").touch()
    assert eds_path(str(path)) == tmp_path / "mine.eds"


def test_unverified_sections_are_named() -> None:
    data = load_profile("generic/cia402").model_dump()
    data["torque"]["confidence"] = "unverified"
    assert CanopenProfile.model_validate(data).below("unverified") == ("torque",)
