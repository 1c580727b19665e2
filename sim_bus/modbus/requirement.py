"""What a parameter has to read, and a value that does."""

from profiles.requirement import Require


def meets(value: float, require: Require) -> bool:
    """The value is as required."""
    near = 1e-9 * max(1.0, abs(value))
    return (
        (require.equals is None or abs(value - require.equals) <= near)
        and (require.one_of is None or any(abs(value - one) <= near for one in require.one_of))
        and (require.at_least is None or value >= require.at_least - near)
        and (require.at_most is None or value <= require.at_most + near)
    )


def value_that_meets(require: Require) -> float:
    """One that does."""
    if require.equals is not None:
        return require.equals
    choices = require.one_of or tuple(one for one in (require.at_least, require.at_most) if one is not None)
    return next((one for one in choices if meets(one, require)), choices[0])
