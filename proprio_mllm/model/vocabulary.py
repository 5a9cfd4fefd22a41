"""Motion tokens in the language model's vocabulary (paper: motion tokenizer, "the vocabulary is extended").

A code k of the motion codebook is the token `<motion_k>`; a window is written between `<motion_start>` and `<motion_end>`;
`<motion_mask>` hides a code in masked motion. The tokens are ordinary added tokens, not special ones: special ones
would vanish from decoded text.
"""

from __future__ import annotations

from collections.abc import Iterable

from transformers import AddedToken, PreTrainedTokenizerBase

MOTION_START = "<motion_start>"
MOTION_END = "<motion_end>"
MOTION_MASK = "<motion_mask>"


def motion_tokens(codes: int) -> tuple[str, ...]:
    """All token texts for a codebook of `codes` entries: the delimiters, the mask, then the codes in order."""
    if codes < 1:
        raise ValueError(f"codes must be positive, got {codes}")
    return (MOTION_START, MOTION_END, MOTION_MASK, *(f"<motion_{k}>" for k in range(codes)))


def add_motion_tokens(tokenizer: PreTrainedTokenizerBase, codes: int) -> tuple[int, ...]:
    """Adds the motion tokens that are missing and returns the ids of all of them, in the order of `motion_tokens`.

    Raises:
        ValueError: when the tokenizer already holds motion tokens of a larger codebook.
    """
    names = motion_tokens(codes)
    if f"<motion_{codes}>" in tokenizer.get_vocab():
        raise ValueError(f"the tokenizer holds motion tokens beyond {codes} codes; use the codebook size it was made with")
    # Not normalised: matched together with other whole words, longest first, so that `_1` cannot cut `<motion_1>`.
    added: list[str | AddedToken] = [AddedToken(name, normalized=False, special=False) for name in names]
    tokenizer.add_tokens(added)
    vocabulary = tokenizer.get_vocab()
    return tuple(vocabulary[name] for name in names)


def motion_text(codes: Iterable[int | None]) -> str:
    """A window of codes as text between the delimiters; None becomes the mask token."""
    inner = "".join(MOTION_MASK if code is None else f"<motion_{int(code)}>" for code in codes)
    return f"{MOTION_START}{inner}{MOTION_END}"
