"""Tests of what is refused: calls that raise a ValueError with certain words."""

from collections.abc import Callable

import pytest


def refusals(*cases: tuple[Callable, str], given: tuple[str, ...] = ()) -> Callable:
    """A test of each call and the words of its error; `given` names fixtures whose values the calls take."""

    @pytest.mark.parametrize(("call", "words"), cases)
    def test(request, call, words):
        values = [request.getfixturevalue(name) for name in given]
        with pytest.raises(ValueError, match=words):
            call(*values)

    return test
