"""Generates captioned human motion in HumanML3D's directory format, for those who do not have HumanML3D.

The folder has `new_joints/`, `new_joint_vecs/`, `texts/`, `train.txt`, `val.txt`, `test.txt`, `all.txt` as HumanML3D publishes
them, and one addition, `hand_opening/`, because skeletons have no fingers. Clip k of a seed is always the same clip.

Paper: motion data for the tokenizer and for alignment (there: HumanML3D). What is left out: everything that people do besides
household movements.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data.activities import ACTIVITIES, RECIPES
from data.files import write_text
from data.motion import FPS
from data.representation import joints_from_vectors, vectors_from_joints
from data.script import Script
from data.skeleton import Caption, HumanMotion, to_y_up

Array = NDArray[np.float64]
#: Raised when the same seed gives other clips than before.
GENERATOR_VERSION: Final = 4
_DURATION_S: Final = (2.0, 10.0)
#: Nothing in a household is faster; an arm that folds close by its shoulder can be.
_FASTEST_M_S: Final = 5.0
_SUBJECTS: Final = ("a person", "someone", "the person", "a man", "a woman", "the figure")
_JOINERS: Final = (" and then ", ", then ", " before the person ")
_TAGS: Final = {
    "DET": "a an the both one two few his her their",
    "ADP": "to at in on with out of up down from by near above before without using while at for",
    "ADV": "forward ahead back backward backwards sideways slowly quickly then again still deeply slightly away closer",
    "CCONJ": "and",
    "ADJ": "small heavy several",
    "NOUN": "steps hands arms sides knees degrees",
}
_TAG_OF: Final = {word: tag for tag, words in _TAGS.items() for word in words.split()}


def generate_clip(seed: int, number: int) -> HumanMotion:
    """Clip `number` of a seed: 2 to 10 s at 20 frames per second, no joint faster than 5 m/s.

    The recipes take turns, so that a few dozen clips cover every activity. Nine in ten clips are for training, the others
    alternate between validation and test.
    """
    recipe = RECIPES[number % len(RECIPES)]
    for attempt in range(100):
        rng = np.random.default_rng([GENERATOR_VERSION, seed, number, attempt])
        script = Script(rng)
        spans: list[tuple[float, float, list[str]]] = []
        for name in recipe:
            begin = script.time_s
            phrases = ACTIVITIES[name](script)
            spans.append((begin, script.time_s, phrases))
        script.wait(float(rng.uniform(0.15, 0.5)))
        if not _DURATION_S[0] <= script.time_s <= _DURATION_S[1] - 0.1:
            continue
        joints, opening = script.render(FPS)
        if np.linalg.norm(np.diff(joints, axis=0), axis=-1).max() * FPS < _FASTEST_M_S:
            turn = number % 20
            split = "val" if turn == 9 else "test" if turn == 19 else "train"
            return HumanMotion(f"{number:06d}", joints, FPS, _captions(rng, spans), opening, split)
    raise AssertionError(f"recipe {recipe} never fits {_DURATION_S} s")


def _captions(rng: np.random.Generator, spans: list[tuple[float, float, list[str]]]) -> tuple[Caption, ...]:
    captions: list[Caption] = []
    for _ in range(3):
        text = str(rng.choice(_SUBJECTS)) + " "
        text += str(rng.choice(_JOINERS)).join(phrases[int(rng.integers(len(phrases)))] for _, _, phrases in spans)
        text += "."
        if text not in [caption.text for caption in captions]:
            captions.append(Caption(text))
    if len(spans) > 1:
        begin, end, phrases = spans[int(rng.integers(len(spans)))]
        text = f"{rng.choice(_SUBJECTS)} {phrases[int(rng.integers(len(phrases)))]}."
        captions.append(Caption(text, round(begin, 1), round(end, 1)))
    return tuple(captions)


def _tagged(text: str) -> str:
    words = text.replace(",", " ,").rstrip(".").split()
    return " ".join(
        f"{word}/{_TAG_OF.get(word, 'NUM' if word.isdigit() else 'VERB' if word.endswith('s') else 'NOUN')}"
        for word in words
        if word != ","
    )


def write_dataset(folder: Path, clips: int, seed: int) -> Path:
    """Writes the generated data set unless the folder already holds the same one.

    Args:
        folder: data set folder, made when absent.
        clips: number of clips.
        seed: which clips.

    Returns:
        The folder.

    Raises:
        ValueError: when `clips` is not positive, or the folder holds something that this function did not write.
    """
    if clips <= 0:
        raise ValueError(f"clips {clips} must be positive")
    recipe = {"generator_version": GENERATOR_VERSION, "clips": clips, "seed": seed}
    note = folder / "generated.json"
    if note.is_file() and json.loads(note.read_text(encoding="utf-8")) == recipe:
        return folder
    if folder.exists() and any(folder.iterdir()) and not note.is_file() and not (folder / ".writing").is_file():
        raise ValueError(f"{folder} is not empty and was not generated; choose another folder")
    for name in ("new_joints", "new_joint_vecs", "texts", "hand_opening"):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for stale in (folder / name).iterdir():
            stale.unlink()
    (folder / ".writing").write_text("", encoding="utf-8")
    note.unlink(missing_ok=True)
    splits: dict[str, list[str]] = {"train": [], "val": [], "test": [], "all": []}
    for number in range(clips):
        clip = generate_clip(seed, number)
        vectors = vectors_from_joints(to_y_up(clip.joints))
        joints = joints_from_vectors(vectors)
        assert clip.hand_opening is not None
        np.save(folder / "new_joint_vecs" / f"{clip.name}.npy", vectors.astype(np.float32))
        np.save(folder / "new_joints" / f"{clip.name}.npy", joints.astype(np.float32))
        np.save(folder / "hand_opening" / f"{clip.name}.npy", clip.hand_opening[: len(joints)].astype(np.float32))
        lines = [f"{c.text}#{_tagged(c.text)}#{c.start_s:.1f}#{c.end_s:.1f}" for c in clip.captions]
        (folder / "texts" / f"{clip.name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        splits[clip.split].append(clip.name)
        splits["all"].append(clip.name)
    for split, names in splits.items():
        (folder / f"{split}.txt").write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    write_text(note, json.dumps(recipe))
    (folder / ".writing").unlink()
    return folder
