"""The operator learns, once, which settings a run left in the drive."""

from drivers.drive import NOT_RESTORED


def test_settings_that_could_not_be_restored_are_said_once(world):
    here, said = world(), []
    here.drive.left = (f"6072h: {NOT_RESTORED}", f"6080h: {NOT_RESTORED}", "1016h:1: the drive refused")
    assert here.runner(say=said.append).run().cause is None
    (text,) = [one for one in said if "not restored" in one]
    assert text == (
        f"not restored in the drive: 6072h, 6080h: {NOT_RESTORED}; 1016h:1: the drive refused. "
        "Check these settings at the drive before the next run"
    )


def test_without_such_a_setting_nothing_is_said(world):
    here, said = world(), []
    assert here.runner(say=said.append).run().cause is None
    assert not any("restored" in one for one in said)
