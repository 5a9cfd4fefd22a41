"""Proprio-MLLM: Qwen2.5-VL with MPE and CSE, a wrapper that hands visual tokens and position ids to the unchanged model.

The wrapper computes the visual tokens, passes them through the CSE and the additive MPE, and gives them to the model as
`mm_encoder_outputs` together with position ids from the collator. With `cse.named`, words behind a picture get F3D of what they
name, in training and as they are written. With `mpe.mode=mrope` and `cse.enabled=false` the result is
the base model's, bit for bit but for the patch embedding (`backbone.PatchEmbedding`).

Shape letters: B batch, S sequence, I images, N visual tokens per image, D hidden size, V vocabulary.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from peft import PeftModel
from torch import Tensor, nn
from torch.nn import functional
from transformers import Cache, DynamicCache, Qwen2_5_VLForConditionalGeneration
from transformers.modeling_outputs import BaseModelOutputWithPooling

from configs.schema.model import ModelConfig
from proprio_mllm.model.batch import IGNORE, Batch, ImageBatch, Sight
from proprio_mllm.model.branches import Branches, read_branches
from proprio_mllm.model.cse import CrossSpatialEncoder
from proprio_mllm.model.mpe import SignEmbedding
from proprio_mllm.model.named_map import NamedPointMap
from proprio_mllm.model.point_map import GeoFeatures
from proprio_mllm.model.processor import ProprioProcessor
from proprio_mllm.model.spatial_cache import SpatialCache
from proprio_mllm.model.word_tokens import first_word


@dataclass(frozen=True, slots=True)
class ModelOutput:
    """Result of a forward pass.

    Attributes:
        loss: mean cross-entropy over the supervised tokens; 0 when there is none.
        supervised: number of supervised tokens, to weigh accumulated batches.
        correct: number of supervised tokens predicted right (argmax).
        visual: (I, N, D) visual tokens before CSE and MPE, for dense losses; None without images.
        logits: (B, S, V) when asked for.
    """

    loss: Tensor
    supervised: int
    correct: int
    visual: Tensor | None
    logits: Tensor | None = None


class ProprioMLLM(nn.Module):
    """The whole model.

    Args:
        vlm: Qwen2.5-VL, or the same wrapped by peft.
        cfg: switches.
        processor: tokenizer and image processor; its special ids are never generated.
        motion_ids: ids of the motion tokens, in the order of `vocabulary.motion_tokens`.
        point_map: encoder of F3D; needed when CSE is enabled.
    """

    #: Tells training loops that the loss is already a mean over this batch's supervised tokens.
    accepts_loss_kwargs = False

    def __init__(
        self,
        vlm: Qwen2_5_VLForConditionalGeneration | PeftModel,
        cfg: ModelConfig,
        processor: ProprioProcessor,
        motion_ids: Sequence[int],
        point_map: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.vlm = vlm
        self.cfg = cfg
        self.processor = processor
        self.motion_ids = tuple(motion_ids)
        hidden = self.hidden_size
        self.point_map = point_map if cfg.cse.enabled else None
        self.cse: CrossSpatialEncoder | None = None
        #: Where training keeps what the frozen point map makes of an image.
        self.seen: SpatialCache | None = None
        if cfg.cse.enabled:
            if point_map is None:
                raise ValueError("cse.enabled needs a point map, got None")
            encoder: Any = point_map
            self.cse = CrossSpatialEncoder(cfg.cse, hidden, int(encoder.token_dim), isinstance(encoder, NamedPointMap))
            point_map.requires_grad_(False)
            if isinstance(point_map, NamedPointMap) and self.cse.named is not None:
                self.cse.named.score_like(point_map.scale, point_map.bias)
        self.mpe = SignEmbedding(hidden) if cfg.mpe.mode in ("embed_sign", "rope_sign+embed") else None
        tokenizer = processor.tokenizer
        names = ("<|image_pad|>", "<|video_pad|>", "<|vision_start|>", "<|vision_end|>", "<|vision_pad|>", "<|im_start|>")
        rows = self.table.shape[0]
        # Rows beyond the tokenizer have no text; pads in a reply would ask for images that are not there.
        self._never = [*tokenizer.convert_tokens_to_ids(list(names)), *range(len(tokenizer), rows)]
        self._end = int(tokenizer.convert_tokens_to_ids("<|im_end|>"))
        self._pad = int(tokenizer.pad_token_id)
        self._image = int(tokenizer.convert_tokens_to_ids(processor.image_token))

    @property
    def core(self) -> Qwen2_5_VLForConditionalGeneration:
        """The Qwen2.5-VL model itself, adapters (if any) injected."""
        vlm: Any = self.vlm
        core: Any = vlm.get_base_model() if isinstance(vlm, PeftModel) else vlm
        return core

    @property
    def hidden_size(self) -> int:
        """Width D of the language model."""
        text: Any = self.core.config.text_config
        return int(text.hidden_size)

    @property
    def table(self) -> Tensor:
        """Input embeddings (V, D); with adapters, the rows below the replaced ones."""
        embeddings: Any = self.core.get_input_embeddings()
        return embeddings.weight

    @property
    def device(self) -> torch.device:
        """Device of the parameters."""
        return next(self.parameters()).device

    def visual_tokens(self, images: ImageBatch) -> Tensor:
        """Merged visual tokens F2D (I, N, D), raster order, before CSE and MPE."""
        model: Any = self.core.model  # its decorators hide the signature
        features = model.get_image_features(images.pixel_values, images.grid_thw, return_dict=True)
        return torch.stack(features.pooler_output)

    def look(self, batch: Batch) -> Batch:
        """The batch with what the model makes of its images; to be called once, before rows go on by `Batch.then`."""
        if batch.images is None or batch.sight is not None:
            return batch
        images, (h, w) = batch.images, batch.images.grid
        visual = tokens = self.visual_tokens(images)
        places = None
        if self.cse is not None:
            spatial, geo = self.spatial(images)
            tokens = self.cse(tokens, spatial)
            places = self.cse.places(visual, spatial, geo, images.camera_in_pelvis)
        if self.mpe is not None:
            tokens = tokens + torch.stack([self.mpe(h, w, place) for place in images.centroids]).to(tokens.dtype)
        count = (batch.input_ids == self._image).sum(1) // visual.shape[1]
        last = (count.cumsum(0) - 1).masked_fill(count == 0, -1)
        return replace(batch, sight=Sight(visual, tokens, places, last, batch.input_ids[:, :0]))

    def named(self, batch: Batch) -> Tensor | None:
        """What the words of a batch get of the last picture before them (B, S, D), or None where nothing is looked up."""
        sight = batch.sight
        if sight is None or sight.places is None:
            return None
        assert self.cse is not None and self.cse.named is not None
        ids = torch.cat([sight.before, batch.input_ids], dim=1)
        seen = ids == self._image
        behind = (seen.flip(1).cumsum(1).flip(1) == 0) & (sight.last >= 0)[:, None]
        words = behind & (ids >= first_word(self.processor.tokenizer))
        most = int(words.sum(1).max())
        order = (~words).int().argsort(dim=1, stable=True)[:, :most]  # where the words of each row are
        kept = words.gather(1, order)[..., None]
        rows = self.table.detach()[ids.gather(1, order)] * kept
        given = self.cse.named(rows, sight.places.of(sight.last)) * kept
        place = order[..., None].expand(-1, -1, rows.shape[2])
        return given.new_zeros(*ids.shape, rows.shape[2]).scatter(1, place, given)[:, sight.before.shape[1] :]

    def keep_spatial(self) -> None:
        """From now on, what the point map makes of an image is kept (`spatial_cache`); not of one that words look into."""
        if self.cse is not None and self.point_map is not None and not self.cse.names:
            self.seen = SpatialCache(self.point_map, self.cse)

    @torch.no_grad()
    def spatial(self, images: ImageBatch) -> tuple[Tensor, GeoFeatures | None]:
        """F3D on the merged grid (`CrossSpatialEncoder.spatial`) and what it is made of; F3D alone where `self.seen` is."""
        assert self.cse is not None and self.point_map is not None
        if self.seen is not None:
            return self.seen.spatial(self.cse, self.point_map, images), None
        geo = self.point_map(images.rgb, images.points_m, images.stance)
        return self.cse.spatial(geo, *images.grid, images.camera_in_pelvis), geo

    def _inputs(self, batch: Batch) -> dict[str, Any]:
        inputs: dict[str, Any] = {
            "input_ids": batch.input_ids,
            "attention_mask": batch.attention_mask,
            "position_ids": batch.position_ids,
        }
        if batch.images is not None:
            assert batch.sight is not None
            per_image: Any = tuple(batch.sight.tokens)  # one entry per image, as Qwen2.5-VL returns it
            inputs["mm_encoder_outputs"] = {"image": BaseModelOutputWithPooling(pooler_output=per_image)}
        given = self.named(batch)
        if given is not None:
            embedded = self._embedded(batch.input_ids)
            inputs["inputs_embeds"] = embedded + given.to(embedded.dtype)
        return inputs

    def _embedded(self, ids: Tensor) -> Tensor:
        """Embeddings of tokens, those of the adapter's rows among them."""
        embeddings: Any = self.core.get_input_embeddings()
        return embeddings(ids)

    def forward(self, batch: Batch, return_logits: bool = False) -> ModelOutput:
        """Loss of a batch; of a part of one, what it adds to the whole batch's.

        Args:
            batch: from the collator.
            return_logits: also compute the logits of every position.
        """
        batch = self.look(batch)
        inputs = self._inputs(batch)
        if bool((batch.attention_mask.diff(dim=1) <= 0).all()):
            # Padding stands right of every token, where causal attention never looks: no mask, and the fast kernel.
            inputs["attention_mask"] = None
        hidden = self._beside(batch, inputs) if batch.logs else self.core.model(**inputs, use_cache=False)[0]  # (B, S, D)
        # Logits are computed where something is learnt only: V is large, targets are few.
        target = batch.labels[:, 1:]
        chosen = target != IGNORE
        picked = target[chosen]
        count = int(picked.numel())
        logits = self.core.lm_head(hidden[:, :-1][chosen]).float()  # (targets, V)
        loss = functional.cross_entropy(logits, picked, reduction="sum") / max(batch.out_of or count, 1)
        correct = int((logits.detach().argmax(-1) == picked).sum()) if count else 0
        everything = self.core.lm_head(hidden) if return_logits else None
        return ModelOutput(loss, count, correct, None if batch.sight is None else batch.sight.visual, everything)

    def _beside(self, batch: Batch, inputs: Mapping[str, Any]) -> Tensor:
        """Last hidden states (B, S, D) of rows that go on from logs."""
        assert batch.logs is not None
        (logs, size), turns = batch.logs.ids.shape, batch.logs.read.shape[1]

        def joined(before: Tensor, rows: Tensor) -> Tensor:  # (E, M) and (E * N, S) to (E, M + N * S)
            return torch.cat([before, rows.unflatten(-2, (logs, turns)).flatten(-2)], -1)

        more = {name: inputs[name] for name in ("mm_encoder_outputs", "inputs_embeds") if name in inputs}
        if "inputs_embeds" in more:
            rows = more["inputs_embeds"].unflatten(0, (logs, turns)).flatten(1, 2)  # (E, N * S, D)
            more["inputs_embeds"] = torch.cat([self._embedded(batch.logs.ids), rows], 1)
        hidden = read_branches(
            self.core.model,
            joined(batch.logs.ids, batch.input_ids),
            joined(torch.arange(size, device=self.device).expand(3, logs, size), batch.position_ids),
            Branches(size, batch.logs.read),
            joined(batch.logs.kept, batch.attention_mask > 0),
            **more,
        )
        return hidden[:, size:].unflatten(1, (turns, -1)).flatten(0, 1)

    @torch.no_grad()
    def following(self, batch: Batch, cache: Cache) -> Tensor:
        """Scores (B, V) of what follows each row.

        Args:
            batch: left-padded rows that have been looked at (`look`); their attention mask covers what the cache holds too,
                where any of it is padding.
            cache: what was read before; takes in the rows.
        """
        inputs = self._inputs(batch)
        if bool(batch.attention_mask.all()):
            inputs["attention_mask"] = None
        out = self.core.model(**inputs, past_key_values=cache, use_cache=True)
        return self.core.lm_head(out.last_hidden_state[:, -1]).float()

    @torch.no_grad()
    def generate(
        self,
        batch: Batch,
        max_new_tokens: int = 48,
        temperature: float = 0.0,
        generator: torch.Generator | Sequence[torch.Generator] | None = None,
        allowed: Sequence[Sequence[Sequence[int]]] | None = None,
    ) -> list[list[int]]:
        """Continues each row of a left-padded batch.

        Args:
            batch: from the collator with `generation=True`.
            max_new_tokens: longest reply.
            temperature: 0 takes the most likely token, otherwise tokens are drawn.
            generator: draws the tokens, on the CPU; one per row keeps a row's draws apart from the other rows'.
            allowed: token ids of the replies that each row has to choose among; None leaves them free.

        Returns:
            The new token ids of each row, without the closing token.

        Raises:
            ValueError: on right padding, a negative temperature, or another number of generators than rows.
        """
        if isinstance(generator, Sequence) and len(generator) != len(batch.input_ids):
            raise ValueError(f"{len(generator)} generators for {len(batch.input_ids)} rows; allowed: one, or one per row")
        if temperature < 0:
            raise ValueError(f"temperature {temperature} must not be negative")
        if int(batch.attention_mask[:, -1].min()) == 0:
            raise ValueError("generation needs left padding: the last position of a row is padding")
        batch, cache = self.look(batch), DynamicCache()
        replies: list[list[int]] = [[] for _ in range(len(batch.input_ids))]
        done = torch.zeros(len(replies), dtype=torch.bool, device=batch.input_ids.device)
        for _ in range(max_new_tokens):
            logits = self.following(batch, cache)
            logits[:, self._never] = float("-inf")
            if allowed is not None:
                free, logits = logits, torch.full_like(logits, float("-inf"))
                for row, (said, choices) in enumerate(zip(replies, allowed, strict=True)):
                    may = [[*one, self._end][len(said)] for one in choices if list(one[: len(said)]) == said]
                    logits[row, may] = free[row, may]
            token = self._choose(logits, temperature, generator)  # (B,)
            done |= token == self._end
            if bool(done.all()):
                break
            for row, (value, over) in enumerate(zip(token.tolist(), done.tolist(), strict=True)):
                if not over:
                    replies[row].append(value)
            batch = batch.then(token.masked_fill(done, self._pad)[:, None])
        return replies

    @staticmethod
    def _choose(logits: Tensor, temperature: float, generator: torch.Generator | Sequence[torch.Generator] | None) -> Tensor:
        if temperature == 0:
            return logits.argmax(-1)
        shares = (logits / temperature).softmax(-1).cpu()
        if isinstance(generator, Sequence):
            rows = [torch.multinomial(row, 1, generator=own) for row, own in zip(shares, generator, strict=True)]
            return torch.cat(rows).to(logits.device)
        return torch.multinomial(shares, 1, generator=generator)[:, 0].to(logits.device)

    def reply(
        self, batch: Batch, max_new_tokens: int = 48, temperature: float = 0.0, allowed: Sequence[Sequence[str]] | None = None
    ) -> list[str]:
        """`generate`, decoded to text, motion tokens included; `allowed` are texts."""
        encode: Any = partial(self.processor.tokenizer.encode, add_special_tokens=False)
        spelt = None if allowed is None else [list(map(encode, choices)) for choices in allowed]
        rows = self.generate(batch, max_new_tokens, temperature, allowed=spelt)
        return self.processor.tokenizer.batch_decode(rows, skip_special_tokens=True)
