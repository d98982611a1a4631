"""What an error or a warning has to name: the facts, as whole words in any order, whatever the sentence around them."""

import contextlib
import re
from collections.abc import Iterable

import pytest


def named(fact: str, text: str) -> bool:
    """Whether ``fact`` stands in ``text`` by itself: no part of a longer word, and a number no part of another."""
    before = r"(?<![\w.-])" if fact[0].isdigit() else r"(?<!\w)" if fact[0].isidentifier() else ""
    after = r"(?!\w|\.\d)" if fact[-1].isdigit() else r"(?!\w)" if fact[-1].isidentifier() else ""
    return re.search(before + re.escape(fact) + after, text) is not None


def unnamed(text: str, *facts: str | tuple[str, ...]) -> list[str]:
    """Those of ``facts``, strings and tuples of strings, that ``text`` does not name."""
    flat = [fact for given in facts for fact in ((given,) if isinstance(given, str) else given)]
    return [fact for fact in flat if not named(fact, text)]


def naming(sentences: Iterable[str], *facts: str | tuple[str, ...]) -> list[str]:
    """Those of the sentences, of warnings or a log, that name all ``facts``."""
    return [sentence for sentence in sentences if not unnamed(sentence, *facts)]


@contextlib.contextmanager
def refused(kind: type[Exception], *facts: str | tuple[str, ...]):
    """The error is of exactly this kind, and its message names all ``facts`` (see :func:`named`)."""
    with pytest.raises(kind) as info:
        yield info
    assert type(info.value) is kind
    assert not unnamed(str(info.value), *facts), str(info.value)
