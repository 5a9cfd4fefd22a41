"""Cross-spatial encoder (paper: CSE), T = MLP(F2D + Phi(F3D)).

F2D are the merged visual tokens, F3D a point-map encoder's output. The paper leaves open how F3D reaches the tokens' grid: Phi
here is bilinear interpolation of the tokens to the merged grid, mean points of a 2 x 2 subdivision of each cell, and one linear
map. As printed the equation destroys pretrained visual tokens at the start, so by default F2D is added as a residual and the
MLP's last layer starts at zero (off and on are equal at the start); `literal` gives the equation as printed.

What CSE adds to a visual token is of use only to a language model that finds the token by the name of a thing. The released
Qwen2.5-VL does; a small one that is trained from nothing did not learn to (docs/model.md). So beyond the paper, F3D can be
looked up by name (`NamedPoints`): a word behind a picture gets F3D of the cells that look like it. Which do is told by the
point map where it knows what is where (`proprio_mllm.model.named_map`), else by F2D, which dense pretraining ties to names
(`proprio_mllm.model.dense`).

Shape letters: I images, h and w rows and columns of the merged grid, N = h * w, D hidden size, C token channels, B rows of W
words.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from configs.schema.model import CseConfig
from proprio_mllm.model.batch import Places
from proprio_mllm.model.point_map import GeoFeatures

#: Points beyond this are held to it, metres.
FAR_M = 10.0
#: Factor of scores in means over cells: most cells of a picture are unlike a name, and would outweigh the few that are like it.
SHARP = 2.0
#: Most words of a name.
NAME_WORDS = 3


class CrossSpatialEncoder(nn.Module):
    """Adds three-dimensional features to visual tokens.

    Args:
        cfg: switches.
        hidden: D.
        token_dim: C of the point-map encoder, 0 when it has no tokens.
        names: whether it knows what is where.
    """

    def __init__(self, cfg: CseConfig, hidden: int, token_dim: int, names: bool = False) -> None:
        super().__init__()
        if cfg.source in ("tokens", "both") and token_dim == 0:
            raise ValueError(f"cse.source {cfg.source!r} needs a point-map encoder with tokens; allowed without: points")
        self.cfg = cfg
        inputs = (0 if cfg.source == "points" else token_dim) + (0 if cfg.source == "tokens" else 16)
        self.phi = nn.Linear(inputs, hidden)
        inner = cfg.hidden or hidden
        self.mlp = nn.Sequential(nn.Linear(hidden, inner), nn.GELU(), nn.Linear(inner, hidden))
        if not cfg.literal:
            last = self.mlp[2]
            assert isinstance(last, nn.Linear)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
        #: Whether words look into the point map itself.
        self.names = names and cfg.named
        self.named = NamedPoints(8 if names else inputs, hidden) if cfg.named else None

    def spatial(self, geo: GeoFeatures, h: int, w: int, camera_in_pelvis: Tensor | None) -> Tensor:
        """F3D on the merged grid, (I, N, inputs of Phi).

        Args:
            geo: the encoder's output.
            h: rows of the merged grid.
            w: columns.
            camera_in_pelvis: (I, 4, 4) camera poses, needed when `cfg.frame` is `pelvis`.

        Raises:
            ValueError: without poses in the pelvis frame.
        """
        parts: list[Tensor] = []
        if self.cfg.source != "points":
            assert geo.tokens is not None
            tokens = functional.interpolate(geo.tokens.float(), size=(h, w), mode="bilinear", antialias=True)  # (I, C, h, w)
            parts.append(tokens.flatten(2).transpose(1, 2))
        if self.cfg.source != "tokens":
            valid = (geo.conf > 0).to(geo.conf)
            planes = self._planes(geo.points_m, geo.conf, camera_in_pelvis)
            planes = (planes * valid[..., None]).permute(0, 3, 1, 2)  # (I, 4, H, W)
            pooled = functional.adaptive_avg_pool2d(planes, (2 * h, 2 * w))
            share = functional.adaptive_avg_pool2d(valid[:, None], (2 * h, 2 * w))
            pooled = pooled / share.clamp_min(1e-3)  # mean over valid pixels
            cells = pooled.unflatten(2, (h, 2)).unflatten(4, (w, 2))  # (I, 4, h, 2, w, 2)
            parts.append(cells.permute(0, 2, 4, 1, 3, 5).reshape(len(cells), h * w, 16))
        return torch.cat(parts, dim=-1)

    def _planes(self, points_m: Tensor, conf: Tensor, camera_in_pelvis: Tensor | None) -> Tensor:
        """Points in the configured frame and logarithms of their confidence, (I, H, W, 4), of size 1."""
        points = points_m.float()
        if self.cfg.frame == "pelvis":
            if camera_in_pelvis is None:
                raise ValueError("cse.frame 'pelvis' needs a camera pose for every image")
            pose = camera_in_pelvis.to(points)
            points = torch.einsum("iab,ihwb->ihwa", pose[:, :3, :3], points) + pose[:, None, None, :3, 3]
        return torch.cat([points.clamp(-FAR_M, FAR_M) / 2.0, conf.clamp_min(1.0).log()[..., None]], dim=-1)

    def places(
        self, visual: Tensor, spatial: Tensor, geo: GeoFeatures | None, camera_in_pelvis: Tensor | None
    ) -> Places | None:
        """What words look up, or None where they do not: cells of the point map where it knows what they show, else F2D's.

        Args:
            visual: (I, N, D) F2D.
            spatial: (I, N, inputs of Phi).
            geo: the encoder's output; may be missing where it knows no names.
            camera_in_pelvis: (I, 4, 4).
        """
        if self.named is None:
            return None
        if not self.names:
            return Places(visual, spatial, spatial.new_zeros(spatial.shape[:2]))
        assert geo is not None and geo.named is not None
        values = [  # no tokens: among 128 channels of them a place is not found
            self._planes(geo.named.centres_m, geo.named.conf, camera_in_pelvis),
            self._planes(geo.points_m, geo.conf, camera_in_pelvis),
        ]
        return Places(geo.named.keys.flatten(1, 2), torch.cat(values, -1).flatten(1, 2), geo.named.conf.log().flatten(1, 2))

    def forward(self, features: Tensor, spatial: Tensor) -> Tensor:
        """T (I, N, D) from F2D (I, N, D) and what `spatial` gives."""
        own = self.phi.weight.dtype  # stays in float32 under a backbone in half precision
        out = self.mlp(features.to(own) + self.phi(spatial.to(own))).to(features.dtype)
        return out if self.cfg.literal else features + out


class NamedPoints(nn.Module):
    """What words get of a picture that shows what they name.

    A word's cosine with the keys of cells, by itself or together with up to `NAME_WORDS - 1` words before it, whichever is
    larger, tells which cells show it: their values' mean passes an MLP and a gate that opens where the cosine is large.

    Args:
        inputs: F, channels of values.
        hidden: D.
    """

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        # dense pretraining gives cosines of .25 to .55 to what is seen, below .15 to what is not and to other words
        self.scale = nn.Parameter(torch.tensor(20.0).log())
        self.bias = nn.Parameter(torch.tensor(-5.0))
        self.put = nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, hidden))

    @torch.no_grad()
    def score_like(self, scale: Tensor, bias: Tensor) -> None:
        """Starts from the logarithm of a factor and the bias with which keys were trained."""
        self.scale.copy_(scale)
        self.bias.copy_(bias)

    def forward(self, words: Tensor, places: Places) -> Tensor:
        """What is added to the embeddings of words (B, W, D).

        Args:
            words: (B, W, D) rows of the language model's table, one word after the other.
            places: (B, N, ...) of the picture that each row sees.
        """
        own = self.scale.dtype
        rows = words.to(own)
        spans = [rows]
        for count in range(1, min(NAME_WORDS, rows.shape[1])):
            spans.append(spans[-1] + functional.pad(rows[:, :-count], (0, 0, count, 0)))
        unit = functional.normalize(torch.stack(spans), dim=-1)  # (spans, B, W, D)
        cosine = unit @ functional.normalize(places.keys.to(own), dim=-1).mT  # (spans, B, W, N)
        best = cosine.amax(-1).argmax(0)  # (B, W)
        scores = cosine.gather(0, best[None, ..., None].expand(1, *cosine.shape[1:]))[0].float() * self.scale.exp()
        gate = (scores.amax(-1, keepdim=True) + self.bias).sigmoid()
        shares = (SHARP * scores + places.trust[:, None]).softmax(-1).to(own)
        return gate * self.put(shares @ places.values.to(own))
