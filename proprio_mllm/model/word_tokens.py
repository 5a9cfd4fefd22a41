"""Words as tokens: one token per word that the model knows, and slots for words that it does not.

Every word of the sequence of `proprio_mllm.model.wording` is a token of its own, with the blank before it, in the model's
tokenizer. A word that is not among them becomes a slot for the length of an episode, the same in instruction, lists and
answers: so object types that nobody trained on are read and named as well.
"""

from __future__ import annotations

import weakref
from collections.abc import Collection, Iterable, Sequence
from typing import Any, Final

import numpy as np
from transformers import AddedToken

__all__ = ["SLOTS", "WordTokens", "add_word_tokens", "first_word", "known_words"]

#: Different unknown words of an episode.
SLOTS: Final = 16
_SLOT: Final = tuple(f" <word_{number}>" for number in range(SLOTS))


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


def first_word(tokenizer: Any) -> int:
    """The first token that is a word or a slot; they are the last ones that were added."""
    return min(known_words(tokenizer).values())


_KNOWN: Final[weakref.WeakKeyDictionary[Any, dict[str, int]]] = weakref.WeakKeyDictionary()


def known_words(tokenizer: Any) -> dict[str, int]:
    """Token ids by word, slots left out.

    Raises:
        ValueError: when there are none.
    """
    if tokenizer not in _KNOWN:
        added = tokenizer.get_added_vocab()
        found = {text[1:]: int(number) for text, number in added.items() if text.startswith(" ") and text not in _SLOT}
        if not found or any(slot not in added for slot in _SLOT):
            raise ValueError("the tokenizer has no word tokens: the model was not trained on episodes in words")
        _KNOWN[tokenizer] = found
    return _KNOWN[tokenizer]
