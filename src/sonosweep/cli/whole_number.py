"""Options that count things take whole numbers; cyclopts alone would round others."""

from collections.abc import Sequence
from typing import Any, Literal

from cyclopts import Parameter, Token


def whole_number(hint: Any, tokens: Sequence[Token]) -> int:  # Any: a type
    """Return the number that was typed.

    Raises:
        ValueError: If it is not whole.
    """
    del hint
    word = tokens[0].value
    try:
        return int(word)
    except ValueError:
        raise ValueError(f"a whole number is needed, got {word}") from None


def whole_number_or_auto(hint: Any, tokens: Sequence[Token]) -> int | Literal["auto"]:
    """Return the number that was typed, or ``"auto"``.

    Raises:
        ValueError: If it is neither.
    """
    return "auto" if tokens[0].value == "auto" else whole_number(hint, tokens)


WHOLE = Parameter(converter=whole_number)
WHOLE_OR_AUTO = Parameter(converter=whole_number_or_auto)
