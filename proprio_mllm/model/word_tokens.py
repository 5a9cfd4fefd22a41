"""Words as tokens: of a tokenizer made for them, or of one that can spell English already.

A model that is trained from nothing has one token per word of the sequence of `proprio_mllm.model.wording`, with the blank
before it. A word that is not among them becomes a slot for the length of an episode, the same in instruction, lists and
answers: so object types that nobody trained on are read and named as well. A pretrained tokenizer spells every word as it
would in a text; there the words that open a part of the sequence are headings in English.
"""

from __future__ import annotations

import weakref
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np
from transformers import AddedToken

from proprio_mllm.model.wording import END

#: Different unknown words of an episode.
SLOTS: Final = 16
_SLOT: Final = tuple(f" <word_{number}>" for number in range(SLOTS))
#: How a text says the words that open a part of the sequence; other words are said as they are.
_HEADINGS: Final[Mapping[str, str]] = {
    "room": "\nIn the room:", "did": "\nDone:", "now": "\nNow:", "do": "\nDo:", "see": "; in view:", "fail": "; failed:",
    "tried": "; tried:", "&": " and", "unseen": " something unseen", "why": "; why did it fail?",
}  # fmt: skip
_GLUED: Final = (END, ",", ";", ":", "_")


class Tokens(Protocol):
    """Token ids of the words of one episode."""

    #: Tokens of a long sequence for one of `WordTokens`.
    length: float

    def tokens(self, words: Sequence[str]) -> list[int]:
        """The tokens of some words, one word after the other."""
        ...


def tokens_of(tokenizer: Any, rng: np.random.Generator | None = None) -> Tokens:
    """The tokens of an episode's words: their own where the tokenizer has them, otherwise those of English text.

    Args:
        tokenizer: of the model.
        rng: see `WordTokens`.
    """
    return WordTokens(tokenizer, rng) if _words_in(tokenizer) else EnglishTokens(tokenizer)


class EnglishTokens:
    """Words spelt by a pretrained tokenizer.

    Args:
        tokenizer: a byte-level one, such as Qwen's.
    """

    length = 2.0

    def __init__(self, tokenizer: Any) -> None:
        self._tokenizer = tokenizer
        self._spelt = _SPELT.setdefault(tokenizer, {})

    def tokens(self, words: Sequence[str]) -> list[int]:
        """The tokens of some words."""
        return [token for word in words for token in self._of(word)]

    def _of(self, word: str) -> tuple[int, ...]:
        if word not in self._spelt:
            text = _HEADINGS.get(word, word if word.startswith(_GLUED) else f" {word}")
            self._spelt[word] = tuple(self._tokenizer(text, add_special_tokens=False)["input_ids"])
        return self._spelt[word]


_SPELT: Final[weakref.WeakKeyDictionary[Any, dict[str, tuple[int, ...]]]] = weakref.WeakKeyDictionary()


def add_word_tokens(tokenizer: Any, words: Iterable[str]) -> None:
    """Adds a token for every word and slot that the tokenizer lacks."""
    texts = [f" {word}" for word in dict.fromkeys(words)] + list(_SLOT)
    tokenizer.add_tokens([AddedToken(text, normalized=False, special=False, single_word=True) for text in texts])


class WordTokens:
    """Token ids of the words of one episode.

    Args:
        tokenizer: with the tokens of `add_word_tokens`.
        rng: draws the slots of unknown words, as training does; None takes them in order.

    Raises:
        ValueError: when the tokenizer has no word tokens.
    """

    length = 1.0

    def __init__(self, tokenizer: Any, rng: np.random.Generator | None = None) -> None:
        self.known = known_words(tokenizer)
        order = range(SLOTS) if rng is None else rng.permutation(SLOTS)
        first = max(self.known.values()) + 1  # slots follow the words
        self._free = [first + int(index) for index in order][::-1]
        self._slots: dict[str, int] = {}

    def tokens(self, words: Sequence[str]) -> list[int]:
        """The tokens of some words; an unknown word in `s` is its stem and the ending, so that plurals name the same thing."""
        return [token for word in words for token in self._of(word)]

    def _of(self, word: str) -> tuple[int, ...]:
        found = self.known.get(word)
        if found is not None:
            return (found,)
        if word.endswith("s") and len(word) > 2:
            return (*self._of(_stem(word, self.known)), self.known["s"])
        if word not in self._slots:
            self._slots[word] = self._free.pop() if len(self._free) > 1 else self._free[0]
        return (self._slots[word],)


def _stem(word: str, known: Collection[str]) -> str:
    """The word without its plural ending: `boxes`, `knives`, `mugs`."""
    stems = [word[:-1]]
    stems += [word[:-2]] if word.endswith("es") else []
    stems += [f"{word[:-3]}fe"] if word.endswith("ves") else []
    return next((stem for stem in stems if stem in known), word[:-1])


def opening(tokenizer: Any) -> int:
    """How many tokens the word has that opens an answer."""
    return len(tokens_of(tokenizer).tokens(["do"]))


def first_word(tokenizer: Any) -> int:
    """The first token that an answer may hold: the words and slots are the last ones that were added; 0 without any."""
    return min(_words_in(tokenizer).values(), default=0)


def known_words(tokenizer: Any) -> dict[str, int]:
    """Token ids by word, slots left out.

    Raises:
        ValueError: when there are none.
    """
    if not _words_in(tokenizer):
        raise ValueError("the tokenizer has no word tokens: the model was not trained on episodes in words")
    return _words_in(tokenizer)


_KNOWN: Final[weakref.WeakKeyDictionary[Any, dict[str, int]]] = weakref.WeakKeyDictionary()


def _words_in(tokenizer: Any) -> dict[str, int]:
    if tokenizer not in _KNOWN:
        added = tokenizer.get_added_vocab()
        found = {text[1:]: int(number) for text, number in added.items() if text.startswith(" ") and text not in _SLOT}
        _KNOWN[tokenizer] = found if all(slot in added for slot in _SLOT) else {}
    return _KNOWN[tokenizer]
