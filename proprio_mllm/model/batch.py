"""From examples to batch tensors: images, token ids, position ids, labels.

An `Example` is a conversation and the views it shows. The collator expands each image's pad, computes the position ids of the
configured MPE mode and masks the labels. Long examples are refused, never cut: a cut inside an image would misalign features.

Motion that a prompt shows stands beside the text: it takes the positions before the one at which it begins, and the text goes
on there, as far from what it answers as without it. (Decisions that have to read across 50 positions more lose half of their
exactness before training, and a part of it after.) Motion that is learnt, or generated, takes positions as text does.

Shape letters: B batch, S sequence, I images of the batch, P patches, H and W image rows and columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from configs.schema.model import ModelConfig
from interface.observation import Camera
from proprio_mllm.model.chat import Encoded, Message, encode
from proprio_mllm.model.geometry import centroid, stance
from proprio_mllm.model.mpe import Centroid, position_ids
from proprio_mllm.model.processor import ProprioProcessor
from proprio_mllm.model.vocabulary import MOTION_END, MOTION_START

IGNORE = -100
#: Tokens before a row that may begin a name in it.
TOLD = 4


@dataclass(frozen=True, slots=True)
class View:
    """One image with what is known of the robot that took it.

    Attributes:
        image: (H, W, 3) uint8.
        camera: the camera, None for images from elsewhere.
        key_bodies: (K, 3) metres, pelvis heading frame, None when unknown.
        points_m: (H, W, 3) true points in the camera frame for the oracle point map; NaN where there is none.
    """

    image: NDArray[np.uint8]
    camera: Camera | None = None
    key_bodies: NDArray[np.floating] | None = None
    points_m: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True)
class Example:
    """A conversation, or a sequence that is tokens already, and its views in the order of its images.

    Attributes:
        messages: the conversation; none where there are tokens.
        views: one per image.
        tokens: the sequence, one pad per image.
        start: position of its first token, where what stands before it has been read already.
    """

    messages: tuple[Message, ...] = ()
    views: tuple[View, ...] = ()
    tokens: Encoded | None = None
    start: int = 0

    @property
    def length(self) -> int:
        """Characters or tokens, to tell long ones from short ones."""
        return sum(len(message.text) for message in self.messages) if self.tokens is None else len(self.tokens.ids)


class Movable:
    """Moves every tensor of a dataclass."""

    def to(self, device: torch.device | str) -> Self:
        """A copy on `device`."""
        moved = {}
        for f in fields(self):  # type: ignore[arg-type]  # every subclass is a dataclass
            value = getattr(self, f.name)
            if isinstance(value, (Tensor, Movable)):
                moved[f.name] = value.to(device)
            elif isinstance(value, tuple) and value and all(isinstance(item, Movable) for item in value):
                moved[f.name] = tuple(item.to(device) for item in value)
        return replace(self, **moved)  # type: ignore[type-var]  # every subclass is a dataclass


@dataclass(frozen=True, slots=True)
class ImageBatch(Movable):
    """Images of one size.

    Attributes:
        pixel_values: (P, 1176) patches as Qwen's image processor gives them.
        grid_thw: (I, 3) patches per image in time, rows and columns.
        rgb: (I, 3, H, W) uint8, for the point map.
        grid: (h, w) of the merged tokens, the same for every image.
        centroids: the robot's place in each image as fractions, or None.
        camera_in_pelvis: (I, 4, 4), or None when some image has no camera.
        stance: (I, 3, 4) how the cameras stand (`geometry.stance`), or None when some image has no camera or no robot.
        points_m: (I, H, W, 3) true points, or None when some image has none.
    """

    pixel_values: Tensor
    grid_thw: Tensor
    rgb: Tensor
    grid: tuple[int, int]
    centroids: tuple[Centroid | None, ...]
    camera_in_pelvis: Tensor | None = None
    stance: Tensor | None = None
    points_m: Tensor | None = None


@dataclass(frozen=True, slots=True)
class Logs(Movable):
    """What the rows of a batch go on from: E logs, each with as many rows N (`proprio_mllm.model.branches`).

    Attributes:
        ids: (E, M) tokens.
        kept: (E, M) those that are no padding.
        read: (E, N) how many of them each row follows.
    """

    ids: Tensor
    kept: Tensor
    read: Tensor


@dataclass(frozen=True, slots=True)
class Places(Movable):
    """What words look up in pictures (`proprio_mllm.model.cse.NamedPoints`), in N cells.

    Attributes:
        keys: (I, N, D), like the rows of the names of what a cell shows.
        values: (I, N, F) of its place.
        trust: (I, N) logarithms of how much each counts.
    """

    keys: Tensor
    values: Tensor
    trust: Tensor

    def of(self, images: Tensor) -> Places:
        """Those of some images (B,)."""
        return Places(self.keys[images], self.values[images], self.trust[images])


@dataclass(frozen=True, slots=True)
class Sight(Movable):
    """What a model has made of the pictures of a batch (`ProprioMLLM.look`); rows that go on still have it.

    Attributes:
        visual: (I, N, D) F2D.
        tokens: (I, N, D) what the language model reads.
        places: what words look up, or None where they do not.
        last: (B,) the last picture of each row, -1 where there is none.
        before: (B, K) the last tokens before the rows.
    """

    visual: Tensor
    tokens: Tensor
    places: Places | None
    last: Tensor
    before: Tensor


@dataclass(frozen=True, slots=True)
class Batch(Movable):
    """Model inputs.

    Attributes:
        input_ids: (B, S).
        attention_mask: (B, S), 0 on padding.
        position_ids: (3, B, S).
        labels: (B, S), -100 where nothing is learnt.
        images: the images of all rows in order, or None.
        out_of: supervised tokens of the whole batch of which it is a part, 0 where it is one by itself.
        logs: what stands before the rows, in the order of the rows; None where each row is all there is.
        sight: what a model has made of the images of these rows, or of what stands before them.
    """

    input_ids: Tensor
    attention_mask: Tensor
    position_ids: Tensor
    labels: Tensor
    images: ImageBatch | None = None
    out_of: int = 0
    logs: Logs | None = None
    sight: Sight | None = None

    def then(self, tokens: Tensor) -> Batch:
        """More text (B, K) after each left-padded row, where a cache holds the rows."""
        mask = torch.cat([self.attention_mask, self.attention_mask.new_ones(tokens.shape)], dim=1)
        after = torch.arange(1, tokens.shape[1] + 1, device=self.position_ids.device)
        sight = self.sight
        if sight is not None:
            sight = replace(sight, before=torch.cat([sight.before, self.input_ids], dim=1)[:, -TOLD:])
        return Batch(tokens, mask, self.position_ids[:, :, -1:] + after, tokens, sight=sight)

    @property
    def supervised(self) -> int:
        """Number of supervised tokens; the first position of a row predicts nothing and is not counted."""
        return int((self.labels[:, 1:] != IGNORE).sum())


def _stacked(values: Sequence[NDArray[np.floating]], count: int) -> Tensor | None:
    """Values of all images, or None when some have none."""
    return torch.from_numpy(np.stack(values)).float() if len(values) == count else None


class Collator:
    """Makes batches.

    Args:
        processor: tokenizer and image processor.
        cfg: the model's configuration: MPE mode and centroid provider.
        max_tokens: longest row that is accepted.
    """

    def __init__(self, processor: ProprioProcessor, cfg: ModelConfig, max_tokens: int = 4096) -> None:
        self.processor = processor
        self.tokenizer = processor.tokenizer
        self.cfg = cfg
        self.max_tokens = max_tokens
        vocabulary = processor.tokenizer.get_vocab()
        self.image_token: int = vocabulary[processor.image_token]
        self._motion = vocabulary.get(MOTION_START), vocabulary.get(MOTION_END)
        self._merge = int(processor.image_processor.merge_size)

    def images(self, views: Sequence[View]) -> ImageBatch:
        """Image tensors of views of one size.

        Raises:
            ValueError: on no view, images of different sizes or of a wrong type.
        """
        if not views:
            raise ValueError("no views")
        shapes = {view.image.shape for view in views}
        if len(shapes) != 1 or next(iter(shapes))[2:] != (3,) or any(view.image.dtype != np.uint8 for view in views):
            raise ValueError(f"images of a batch must be uint8 (H, W, 3) of one size, got {sorted(shapes)}")
        features = self.processor.images([view.image for view in views])
        grid_thw: Tensor = features["image_grid_thw"]
        h, w = (int(n) // self._merge for n in grid_thw[0, 1:])
        rgb = torch.from_numpy(np.stack([view.image for view in views])).permute(0, 3, 1, 2)
        poses = [view.camera.camera_in_pelvis for view in views if view.camera is not None]
        stances = [stance(one.camera, one.key_bodies) for one in views if one.camera is not None and one.key_bodies is not None]
        points = [view.points_m for view in views if view.points_m is not None]
        return ImageBatch(
            pixel_values=features["pixel_values"],
            grid_thw=grid_thw,
            rgb=rgb.contiguous(),
            grid=(h, w),
            centroids=tuple(self._centroid(view) for view in views),
            camera_in_pelvis=_stacked(poses, len(views)),
            stance=_stacked(stances, len(views)),
            points_m=_stacked(points, len(views)),
        )

    def _centroid(self, view: View) -> Centroid | None:
        if view.camera is None or view.key_bodies is None:
            return None
        return centroid(view.camera, view.key_bodies, self.cfg.mpe.centroid)

    def in_parts(self, examples: Sequence[Example], count: int = 3) -> tuple[Batch, ...]:
        """A training batch as a few batches of rows of similar length, so that little is computed on padding.

        The losses of the parts add up to that of the whole batch.

        Args:
            examples: conversations.
            count: number of parts, at most one per two examples.
        """
        ordered = sorted(examples, key=lambda example: example.length)
        count = max(1, min(count, len(ordered) // 2))
        cuts = [len(ordered) * number // count for number in range(count + 1)]
        parts = [self(ordered[first:end]) for first, end in pairwise(cuts)]
        whole = sum(part.supervised for part in parts)
        return tuple(replace(part, out_of=whole) for part in parts)

    def beside(self, logs: Sequence[Sequence[int]], rows: Sequence[Sequence[Example]]) -> Batch:
        """A batch of rows that go on from a log, so that every log is read once.

        Args:
            logs: tokens of each log.
            rows: of each log as many; their `start` tells how much of it they follow.
        """
        batch = self([example for of_log in rows for example in of_log], padding="right")
        pad, length = int(self.tokenizer.pad_token_id), _bucket(max(map(len, logs)), 64)
        extra = _bucket(batch.input_ids.shape[1], 16) - batch.input_ids.shape[1]
        told = [functional.pad(torch.tensor(list(log)), (0, length - len(log)), value=pad) for log in logs]
        kept = torch.arange(length) < torch.tensor([len(log) for log in logs])[:, None]
        return replace(
            batch,
            input_ids=functional.pad(batch.input_ids, (0, extra), value=pad),
            attention_mask=functional.pad(batch.attention_mask, (0, extra)),
            position_ids=functional.pad(batch.position_ids, (0, extra)),
            labels=functional.pad(batch.labels, (0, extra), value=IGNORE),
            logs=Logs(torch.stack(told), kept, torch.tensor([[example.start for example in of_log] for of_log in rows])),
        )

    def __call__(
        self, examples: Sequence[Example], generation: bool = False, padding: Literal["left", "right"] | None = None
    ) -> Batch:
        """Batch of examples.

        Args:
            examples: conversations.
            generation: whether to open the assistant's turn at the end of each row.
            padding: side of the padding; by default left for generation, which needs it, else right.

        Raises:
            ValueError: on an empty batch, a row that is too long, or views that do not match the messages.
        """
        if not examples:
            raise ValueError("no examples")
        side = padding or ("left" if generation else "right")
        if generation and side != "left":
            raise ValueError("generation needs left padding, got 'right'")
        views = [view for example in examples for view in example.views]
        images = self.images(views) if views else None
        rows: list[tuple[list[int], list[int], Tensor]] = []
        first = 0
        for number, example in enumerate(examples):
            encoded = example.tokens or encode(self.tokenizer, example.messages, generation)
            named = encoded.ids.count(self.image_token)
            if named != len(example.views):
                raise ValueError(f"example {number} names {named} images, but it has {len(example.views)} views")
            ids, labels = self._expand(encoded.ids, encoded.targets, images.grid if images else (0, 0))
            if len(ids) > self.max_tokens:
                raise ValueError(f"example {number} has {len(ids)} tokens; at most {self.max_tokens} are allowed")
            places = images.centroids[first : first + named] if images else ()
            grids = [images.grid] * named if images else []
            where = position_ids(ids, self.image_token, grids, places, self.cfg.mpe.mode, example.start)
            self._put_beside(ids, labels, where)
            rows.append((ids, labels, where))
            first += named
        return self._pad(rows, images, side)

    def _put_beside(self, ids: Sequence[int], labels: Sequence[int], where: Tensor) -> None:
        """Moves the positions (3, S) of motion that is not learnt, and of what follows it, back by the motion's length."""
        begin, end = self._motion
        start = None
        for index, (token, label) in enumerate(zip(ids, labels, strict=True)):
            if label == IGNORE and token == begin:
                start = index
            elif token == end and start is not None:
                where[:, start:] -= index + 1 - start
                start = None

    def _expand(self, ids: Sequence[int], targets: Sequence[bool], grid: tuple[int, int]) -> tuple[list[int], list[int]]:
        out: list[int] = []
        labels: list[int] = []
        for token, target in zip(ids, targets, strict=True):
            count = grid[0] * grid[1] if token == self.image_token else 1
            out.extend([token] * count)
            labels.extend([token if target else IGNORE] * count)
        return out, labels

    def _pad(self, rows: list[tuple[list[int], list[int], Tensor]], images: ImageBatch | None, side: str) -> Batch:
        size, count = max(len(ids) for ids, _, _ in rows), len(rows)
        input_ids = torch.full((count, size), int(self.tokenizer.pad_token_id))
        mask = torch.zeros(count, size, dtype=torch.long)
        labels = torch.full((count, size), IGNORE)
        positions = torch.zeros(3, count, size, dtype=torch.long)
        for row, (ids, targets, place) in enumerate(rows):
            span = slice(size - len(ids), size) if side == "left" else slice(0, len(ids))
            input_ids[row, span] = torch.tensor(ids)
            mask[row, span] = 1
            labels[row, span] = torch.tensor(targets)
            positions[:, row, span] = place
        return Batch(input_ids, mask, positions, labels, images)


def _bucket(size: int, step: int) -> int:
    """A size rounded up: kernels are prepared anew for every shape."""
    return -(-size // step) * step
