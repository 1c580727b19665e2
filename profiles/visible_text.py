"""Text from outside (name of a drive, profile, head of a column, log, name of a file) in a form that is safe to show.

A terminal obeys control characters: a name could clear the line that warns of it, change the direction of writing, or
type for the user. Each control character becomes a visible sign without effect.
"""


def visible(text: str, *, keep: str = "") -> str:
    """Return ``text`` on one line, without control characters; the characters in ``keep`` stay."""
    if text.isprintable():
        return text
    return "".join(sign if sign in keep or sign.isprintable() else _shown(sign) for sign in text)


def _shown(sign: str) -> str:
    code = ord(sign)
    if code < 0x20:
        return chr(0x2400 + code)      # ␛ and similar signs
    if code == 0x7F:
        return "␡"
    return " " if sign.isspace() and code not in (0x85, 0x2028, 0x2029) else "·"
