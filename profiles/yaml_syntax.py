"""PyYAML's syntax errors in the words of somebody who edits the file."""

import yaml

_WORDS = (
    (r"'\t' that cannot start", "a tab; indent and separate with spaces"),
    ("mapping values are not allowed", "a ':' where no key can stand; mend the indentation, or put the text in quotes"),
    ("could not find expected ':'", "a key without ':', or a text that runs over the line without quotes"),
    ("expected <block end>", "the indentation does not fit the lines above"),
    ("unexpected end of stream", "a quote or bracket is opened and never closed"),
    ("expected ',' or", "a bracket is not closed, or a ',' is missing"),
    ("that cannot start any token", "a text can't begin with this character; put it in quotes"),
)


def syntax_error(error: yaml.MarkedYAMLError) -> tuple[int, str]:
    """Line (from 1; 0 if unknown) and plain words."""
    mark = error.problem_mark or error.context_mark
    line = int(mark.line) + 1 if mark is not None else 0
    problem = error.problem or error.context or "can't be parsed"
    for part, words in _WORDS:
        if part in problem:
            return line, words
    return line, f"not YAML: {problem}" + (f" ({error.context})" if error.context and error.problem else "")
