"""Text that others wrote (a drive's name, a profile, the head of a column, a log, a file's name), as it may be shown.

A terminal obeys control characters: a name could clear the line that warns of it, turn the writing around, or answer
for the keyboard. Each becomes a sign that is seen and does nothing.
"""


def visible(text: str, *, keep: str = "") -> str:
    """``text`` on one line, without anything that a terminal obeys; the characters in ``keep`` stay."""
    if text.isprintable():
        return text
    return "".join(sign if sign in keep or sign.isprintable() else _shown(sign) for sign in text)


def _shown(sign: str) -> str:
    code = ord(sign)
    if code < 0x20:
        return chr(0x2400 + code)      # ␛ and its like
    if code == 0x7F:
        return "␡"
    return " " if sign.isspace() and code not in (0x85, 0x2028, 0x2029) else "·"
