import json

import numpy as np
import pytest
import torch
from torch.nn import functional

from configs.schema.model import MotionTokenizerConfig
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.quantizer import VectorQuantizer

CFG = MotionTokenizerConfig(features=5, window=16, codes=12, code_dim=6, width=8, depth=2)


def _motion(batch: int = 4, frames: int = 16, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, frames, 5, generator=generator).cumsum(1) * 0.1


def test_quantiser_against_a_loop():
    torch.manual_seed(0)
    quantiser = VectorQuantizer(7, 3, decay=0.9, reset_below=0.0)
    vectors = torch.randn(20, 3)
    quantiser.train()
    quantiser(vectors)  # initialises
    book, counts, sums = quantiser.codebook.clone(), quantiser.counts.clone(), quantiser.sums.clone()
    more = torch.randn(2, 5, 3)
    result = quantiser(more)
    flat = more.reshape(-1, 3)
    nearest = [min(range(7), key=lambda k: float((v - book[k]).pow(2).sum())) for v in flat]
    assert result.ids.flatten().tolist() == nearest
    torch.testing.assert_close(result.vectors.detach().reshape(-1, 3), book[nearest])
    assert float(result.commitment_loss) == pytest.approx(float((flat - book[nearest]).pow(2).mean()), rel=1e-5)
    for k in range(7):
        own = [v for v, n in zip(flat, nearest, strict=True) if n == k]
        counts[k] = 0.9 * counts[k] + 0.1 * len(own)
        sums[k] = 0.9 * sums[k] + 0.1 * (torch.stack(own).sum(0) if own else torch.zeros(3))
        torch.testing.assert_close(quantiser.codebook[k], sums[k] / counts[k])
    share = torch.tensor([nearest.count(k) / 10 for k in range(7)])
    entropy = -(share[share > 0] * share[share > 0].log()).sum()
    assert float(result.perplexity) == pytest.approx(float(entropy.exp()), rel=1e-4)


def test_dead_codes_come_back_as_vectors_of_the_batch():
    quantiser = VectorQuantizer(4, 2, reset_below=1.0).train()
    quantiser(torch.randn(8, 2, generator=torch.Generator().manual_seed(0)))
    quantiser.counts[2] = 0.5
    quantiser.codebook[2] = 1e6
    batch = torch.randn(8, 2, generator=torch.Generator().manual_seed(1))
    quantiser(batch, torch.Generator().manual_seed(2))
    assert any(torch.equal(quantiser.codebook[2], vector) for vector in batch)
    assert quantiser.counts[2] == 1


def test_straight_through_gradient_and_frozen_codebook_in_eval():
    quantiser = VectorQuantizer(4, 2).train()
    quantiser(torch.randn(8, 2))
    before = quantiser.codebook.clone()
    vectors = torch.randn(3, 2, requires_grad=True)
    quantiser.eval()(vectors).vectors.sum().backward()
    assert torch.equal(vectors.grad, torch.ones(3, 2))
    assert torch.equal(quantiser.codebook, before)


def test_small_batches_fill_a_large_codebook():
    quantiser = VectorQuantizer(16, 2).train()
    quantiser(torch.randn(3, 2))
    assert len(torch.unique(quantiser.codebook, dim=0)) == 16


def test_gradient_rule_trains_the_codebook():
    quantiser = VectorQuantizer(4, 2, update="grad", reset_below=0.0).train()
    quantiser(torch.randn(8, 2)).codebook_loss.backward()
    assert quantiser.codebook.grad.abs().sum() > 0
    with pytest.raises(ValueError, match="update 'x'"):
        VectorQuantizer(4, 2, update="x")


def test_codes_outside_the_codebook_are_refused():
    with pytest.raises(ValueError, match=r"outside the codebook \[0, 4\)"):
        VectorQuantizer(4, 2).lookup(torch.tensor([4]))


def test_loss_is_the_papers_sum():
    tokenizer = MotionTokenizer(CFG).eval()
    tokenizer.quantizer.codebook.normal_()
    tokenizer.set_normalisation(np.arange(5) / 10, np.full(5, 0.5))
    motion = _motion()
    loss = tokenizer(motion)
    normal = (motion - torch.arange(5) / 10) / 0.5
    encoded = tokenizer.encoder(normal.transpose(1, 2)).transpose(1, 2)
    chosen = tokenizer.quantizer.codebook[tokenizer.encode(motion)]
    rebuilt = tokenizer.decoder(chosen.transpose(1, 2)).transpose(1, 2)
    expected = (
        functional.smooth_l1_loss(rebuilt, normal)
        + 0.5 * functional.smooth_l1_loss(rebuilt[:, 1:] - rebuilt[:, :-1], normal[:, 1:] - normal[:, :-1])
        + (1.0 + 0.02) * (encoded - chosen).pow(2).mean()
    )
    torch.testing.assert_close(loss.total, expected)
    torch.testing.assert_close(tokenizer.decode(tokenizer.encode(motion)), rebuilt * 0.5 + torch.arange(5) / 10)


def test_learns_and_uses_several_codes():
    torch.manual_seed(0)
    tokenizer = MotionTokenizer(CFG).train()
    motion = _motion(32)
    tokenizer.set_normalisation(motion.mean((0, 1)).numpy(), motion.std((0, 1)).numpy())
    optimiser = torch.optim.AdamW(tokenizer.parameters(), 1e-2)
    errors = []
    for _ in range(80):
        loss = tokenizer(motion)
        optimiser.zero_grad()
        loss.total.backward()
        optimiser.step()
        errors.append(float(loss.reconstruction.detach()))
    assert errors[-1] < 0.8 * errors[0]
    assert loss.perplexity > 3


def test_online_equals_offline():
    tokenizer = MotionTokenizer(CFG).eval()
    tokenizer.quantizer.codebook.normal_()
    long = _motion(1, 40)[0].numpy()
    offline = tokenizer.encode(torch.from_numpy(np.stack([long[k : k + 16] for k in range(20)])))
    for k in range(20):
        assert tokenizer.encode_window(long[: k + 16]) == tuple(offline[k].tolist())
    short = tokenizer.encode_window(long[:3])
    padded = np.concatenate([np.repeat(long[:1], 13, axis=0), long[:3]])
    assert short == tokenizer.encode_window(padded)
    assert len(short) == CFG.window_tokens == 4


def test_round_trip_continues_training_alike(tmp_path):
    torch.manual_seed(0)
    tokenizer = MotionTokenizer(CFG).train()
    tokenizer(_motion(8))
    tokenizer.save(tmp_path / "t")
    loaded = MotionTokenizer.load(tmp_path / "t")
    assert not loaded.training
    for name, value in tokenizer.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    assert not list((tmp_path / "t").glob("*.tmp"))
    config = tmp_path / "t" / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "format": 7}))
    with pytest.raises(ValueError, match="format 7"):
        MotionTokenizer.load(tmp_path / "t")


@pytest.mark.parametrize("shape", [(2, 16, 4), (2, 15, 5), (16, 5), (2, 0, 5)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(ValueError, match="frames a multiple of 4"):
        MotionTokenizer(CFG).encode(torch.zeros(shape))


def test_wrong_windows_and_normalisations_are_refused():
    tokenizer = MotionTokenizer(CFG)
    with pytest.raises(ValueError, match="motion window"):
        tokenizer.encode_window(np.zeros((0, 5)))
    with pytest.raises(ValueError, match="mean: expected 5"):
        tokenizer.set_normalisation(np.zeros(4), np.ones(5))
    with pytest.raises(ValueError, match="std: expected 5"):
        tokenizer.set_normalisation(np.zeros(5), np.full(5, np.nan))
