import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from configs.schema.model import MotionTokenizerConfig
from configs.validate import ConfigError, build
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.quantizer import MotionQuantizer

CFG = MotionTokenizerConfig(features=5, window=16, codes=12, code_dim=6, width=8, depth=2)


def _motion(batch: int = 4, frames: int = 16, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, frames, 5, generator=generator).cumsum(1) * 0.1


def _quantizer(**changes: object) -> MotionQuantizer:
    sizes: dict[str, object] = {
        "features": 5,
        "window": 16,
        "codes": 7,
        "code_dim": 3,
        "width": 8,
        "depth": 2,
        "reset_below": 0.0,
    }
    torch.manual_seed(0)
    return MotionQuantizer(build(MotionTokenizerConfig, sizes | changes, "motion")).train()


def _codebook(quantizer: MotionQuantizer) -> torch.Tensor:
    return quantizer.inner.codebook


def test_quantiser_against_the_papers_equations():
    """Nearest code, both losses and the moving averages, computed with loops."""
    decay = 0.9
    quantizer = _quantizer(ema_decay=decay)
    quantizer(torch.randn(1, 20, 3))  # initialises
    book = _codebook(quantizer).clone()
    inner = quantizer.inner._codebook
    counts, sums = inner.cluster_size[0].clone(), inner.embed_avg[0].clone()
    vectors = torch.randn(2, 5, 3, requires_grad=True)
    result = quantizer(vectors)
    flat = vectors.detach().reshape(-1, 3)
    nearest = [min(range(7), key=lambda k: float((v - book[k]).pow(2).sum())) for v in flat]
    assert result.tokens.flatten().tolist() == nearest
    torch.testing.assert_close(result.vectors.detach().reshape(-1, 3), book[nearest])
    square = float((flat - book[nearest]).pow(2).mean())
    assert float(result.commitment_loss.detach()) == pytest.approx(square, rel=1e-5)
    assert float(result.codebook_loss) == pytest.approx(square, rel=1e-5)
    result.commitment_loss.backward()
    torch.testing.assert_close(vectors.grad.reshape(-1, 3), 2.0 * (flat - book[nearest]) / flat.numel())
    for k in range(7):
        own = [v for v, n in zip(flat, nearest, strict=True) if n == k]
        counts[k] = decay * counts[k] + (1.0 - decay) * len(own)
        sums[k] = decay * sums[k] + (1.0 - decay) * (torch.stack(own).sum(0) if own else torch.zeros(3))
    torch.testing.assert_close(inner.cluster_size[0], counts)
    smoothed = (counts + 1e-5) / (counts.sum() + 7e-5) * counts.sum()  # the library's, against division by zero
    torch.testing.assert_close(_codebook(quantizer), sums / smoothed[:, None])
    share = torch.tensor([nearest.count(k) / 10 for k in range(7)])
    entropy = -(share[share > 0] * share[share > 0].log()).sum()
    assert float(result.perplexity) == pytest.approx(float(entropy.exp()), rel=1e-4)


def test_the_first_codes_are_means_of_the_first_encodings():
    quantizer, vectors = _quantizer(), torch.randn(1, 60, 3) + 50.0
    tokens = quantizer(vectors).tokens[0, :, 0]
    assert len(tokens.unique()) == 7
    for code, vector in enumerate(quantizer.lookup(torch.arange(7).reshape(1, 7, 1))[0]):
        torch.testing.assert_close(vector, vectors[0, tokens == code].mean(0), atol=0.5, rtol=0.0)


def test_residual_codebooks_quantise_what_is_left_over():
    quantizer = _quantizer(quantizer="rvq", stages=2)
    quantizer(torch.randn(1, 40, 3))
    quantizer.eval()
    vectors = torch.randn(1, 6, 3)
    first, second = (layer.codebook for layer in quantizer.inner.layers)
    for step, tokens in zip(vectors[0], quantizer.tokens(vectors)[0], strict=True):
        one = int((step - first).pow(2).sum(1).argmin())
        two = int((step - first[one] - second).pow(2).sum(1).argmin())
        assert tokens.tolist() == [one, 7 + two]
    one, two = quantizer.tokens(vectors)[0, 0].tolist()
    torch.testing.assert_close(quantizer.lookup(quantizer.tokens(vectors))[0, 0], first[one] + second[two - 7])


def test_residual_codebooks_pull_what_is_left_over_to_their_codes():
    quantizer = _quantizer(quantizer="rvq", stages=2)
    quantizer(torch.randn(1, 40, 3))
    first, second = (layer.codebook.clone() for layer in quantizer.inner.layers)
    vectors = torch.randn(1, 6, 3)
    result = quantizer.train()(vectors)
    one, two = (book[index] for book, index in zip((first, second), (result.tokens[0] - torch.tensor([0, 7])).T, strict=True))
    expected = (vectors[0] - one).square().mean() + (vectors[0] - one - two).square().mean()
    torch.testing.assert_close(result.commitment_loss.detach(), expected)


def test_grid_tokens_are_the_rounded_values():
    quantizer = _quantizer(quantizer="fsq", codes=60, levels=(5, 4, 3)).eval()
    vectors = torch.randn(2, 9, 3)
    tokens = quantizer.tokens(vectors)
    assert tokens.shape == (2, 9, 1) and int(tokens.max()) < 60
    torch.testing.assert_close(quantizer.lookup(tokens), quantizer(vectors).vectors)
    with pytest.raises(ValueError, match="make 64 codes, not codes 7"):
        _quantizer(quantizer="fsq", levels=(4, 4, 4))


def test_dead_codes_come_back_as_vectors_of_the_batch():
    quantizer = _quantizer(reset_below=1.0)
    quantizer(torch.randn(1, 30, 3), torch.Generator().manual_seed(0))
    inner = quantizer.inner._codebook
    inner.cluster_size[0, 2] = 0.5
    inner.embed[0, 2] = inner.embed_avg[0, 2] = 1e6
    batch = torch.randn(1, 30, 3)
    quantizer(batch, torch.Generator().manual_seed(2))
    assert any(torch.equal(_codebook(quantizer)[2], vector) for vector in batch[0])


def test_draws_follow_the_generator_and_leave_torchs_own_alone():
    books = []
    for other in (1, 2):
        quantizer = _quantizer()
        torch.manual_seed(other)
        before = torch.get_rng_state()
        quantizer(torch.randn(1, 30, 3, generator=torch.Generator().manual_seed(5)), torch.Generator().manual_seed(7))
        assert torch.equal(torch.get_rng_state(), before)
        books.append(_codebook(quantizer).clone())
    assert torch.equal(*books)


def test_straight_through_gradient_and_frozen_codebook_in_eval():
    for kind in ("vq", "rvq"):
        quantizer = _quantizer(quantizer=kind)
        quantizer(torch.randn(1, 30, 3))
        vectors = torch.randn(1, 3, 3, requires_grad=True)
        quantizer(vectors).vectors.sum().backward()
        torch.testing.assert_close(vectors.grad, torch.ones(1, 3, 3))
        state = {name: value.clone() for name, value in quantizer.eval().state_dict().items()}
        quantizer(torch.randn(1, 30, 3))
        assert all(torch.equal(value, state[name]) for name, value in quantizer.state_dict().items())


def test_small_batches_fill_a_large_codebook():
    quantizer = _quantizer(codes=16, reset_below=1.0)
    for _ in range(3):
        quantizer(torch.randn(1, 20, 3))
    assert len(torch.unique(_codebook(quantizer), dim=0)) > 12


def test_gradient_rule_trains_the_codebook():
    quantizer = _quantizer(update="grad")
    vectors = torch.randn(1, 8, 3)
    result = quantizer(vectors)
    result.codebook_loss.backward()
    book = quantizer.inner._codebook.embed
    chosen = result.tokens.flatten()
    expected = torch.zeros_like(book[0])
    expected.index_add_(0, chosen, 2.0 * (book[0].detach()[chosen] - vectors[0]) / vectors.numel())
    torch.testing.assert_close(book.grad[0], expected)
    with pytest.raises(ConfigError, match="update"):
        _quantizer(update="x")
    with pytest.raises(ValueError, match="update 'grad' is for quantizer vq, not rvq"):
        _quantizer(update="grad", quantizer="rvq")


def test_tokens_outside_the_codebook_are_refused():
    with pytest.raises(ValueError, match=r"motion token 7 outside the codebook \[0, 7\)"):
        _quantizer().lookup(torch.tensor([[[7]]]))
    with pytest.raises(ValueError, match=r"motion token 3 outside the codebook \[7, 14\)"):
        _quantizer(quantizer="rvq").lookup(torch.tensor([[[3, 3]]]))
    with pytest.raises(ValueError, match="3 tokens; expected a multiple of 2"):
        MotionTokenizer(replace(CFG, quantizer="rvq")).decode(torch.zeros(1, 3, dtype=torch.long))


def _spread(tokenizer: MotionTokenizer) -> MotionTokenizer:
    """In evaluation mode, with codes that have seen something."""
    tokenizer.train()(_motion(32), torch.Generator().manual_seed(0))
    return tokenizer.eval()


def test_loss_is_the_papers_sum():
    tokenizer = _spread(MotionTokenizer(CFG))
    tokenizer.set_normalisation(np.arange(5) / 10, np.full(5, 0.5))
    motion = _motion()
    loss = tokenizer(motion)
    normal = (motion - torch.arange(5) / 10) / 0.5
    encoded = tokenizer.encoder(normal.transpose(1, 2)).transpose(1, 2)
    chosen = _codebook(tokenizer.quantizer)[tokenizer.encode(motion)]
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


@pytest.mark.parametrize("kind", ["vq", "rvq", "fsq"])
def test_online_equals_offline(kind):
    tokenizer = _spread(MotionTokenizer(replace(CFG, quantizer=kind, codes=64 if kind == "fsq" else 12, levels=(4, 4, 4))))
    steps = tokenizer.cfg.codebooks
    long = _motion(1, 40)[0].numpy()
    offline = tokenizer.encode(torch.from_numpy(np.stack([long[k : k + 16] for k in range(20)])))
    for k in range(20):
        assert tokenizer.encode_window(long[: k + 16]) == tuple(offline[k].tolist())
    short = tokenizer.encode_window(long[:3])
    padded = np.concatenate([np.repeat(long[:1], 13, axis=0), long[:3]])
    assert short == tokenizer.encode_window(padded)
    assert len(short) == 4 * steps
    assert torch.equal(tokenizer.decode(offline), tokenizer.eval().decode(offline))


def test_motion_may_be_on_another_device(monkeypatch):
    """A GPU's model is given what was read from files; the meta device stands for it."""
    tokenizer = MotionTokenizer(CFG).to("meta")
    monkeypatch.setattr(tokenizer.quantizer, "tokens", lambda vectors: vectors)
    assert tokenizer.encode(_motion(2)).is_meta


def test_round_trip_continues_training_alike(tmp_path):
    torch.manual_seed(0)
    tokenizer = MotionTokenizer(CFG).train()
    tokenizer(_motion(8))
    for _ in range(2):
        tokenizer.save(tmp_path / "not" / "yet" / "t")
    loaded = MotionTokenizer.load(tmp_path / "not" / "yet" / "t")
    assert not loaded.training
    for name, value in tokenizer.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    config = tmp_path / "not" / "yet" / "t" / "config.json"
    assert not list(config.parent.glob("*.tmp"))
    config.write_text(json.dumps({**json.loads(config.read_text()), "format": 7}))
    with pytest.raises(ValueError, match="format 7"):
        MotionTokenizer.load(config.parent)


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
