"""Lookup-free quantisation, from the tokenizer's loss to an imagined frame."""

from pathlib import Path

import pytest
import torch
from torch.nn import functional as F

from lerobot_wmrl.common.tracking import read_metrics
from lerobot_wmrl.data.frames import Frames
from lerobot_wmrl.world_models import losses
from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.autoregressive.network import NextFrameNetwork
from lerobot_wmrl.world_models.checkpoint import load_model
from lerobot_wmrl.world_models.codebook import BinaryCodeBook, CodeBook
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.layers import FrameSizes
from lerobot_wmrl.world_models.losses import (
    corrupt_codes,
)
from lerobot_wmrl.world_models.quantizer import COMMITMENT_WEIGHT, ENTROPY_WEIGHT, LookupFreeQuantizer
from tests.trained import action_config, run_training, tokenizer_config

LEVELS = (16, 16, 16)


def test_lfq_keeps_the_signs_and_its_tokens_name_them():
    quantizer, codebook = LookupFreeQuantizer(LEVELS).eval(), BinaryCodeBook(LEVELS)
    vectors = torch.randn(2, 12, 4, 4)
    quantized = quantizer(vectors)
    assert torch.equal(quantized.values, vectors.sign())
    assert torch.equal(quantizer.values(quantized.tokens), vectors.sign())
    values = codebook.values(codebook.codes(quantized.tokens))
    assert torch.equal(values.permute(0, 3, 1, 2), vectors.sign())
    assert quantized.loss == 0


def test_every_token_is_its_codes_and_every_code_other_signs():
    codebook = BinaryCodeBook((8, 8))
    tokens = torch.arange(64)
    codes = codebook.codes(tokens)
    assert torch.equal(codebook.tokens(codes), tokens)
    assert codebook.channels == 6
    assert len(codebook.values(codes).unique(dim=0)) == 64


def test_the_loss_is_eq_4_and_5_of_magvit_2():
    """Of a factor: entropy of each token's code minus that of all tokens' mean, at temperature 1/100."""
    quantizer, vectors = LookupFreeQuantizer((4, 4)), torch.randn(3, 4, 2, 2) / 100
    signs = torch.tensor([[-1.0, -1], [-1, 1], [1, -1], [1, 1]])
    factors = vectors.permute(0, 2, 3, 1).reshape(-1, 2, 2)
    probability = (2 * 100 * factors @ signs.T).softmax(-1)
    token, code = (torch.special.entr(p).sum(-1).mean() for p in (probability, probability.mean(0)))
    commitment = (vectors - vectors.sign()).square().mean()
    quantized = quantizer(vectors)
    expected = ENTROPY_WEIGHT * (token - code) + COMMITMENT_WEIGHT * commitment
    torch.testing.assert_close(quantized.loss, expected, atol=1e-4, rtol=1e-4)
    assert quantized.metrics["token_entropy"] == pytest.approx(token.item(), abs=1e-3)
    assert quantized.metrics["code_entropy"] == pytest.approx(code.item(), abs=1e-3)
    assert quantized.metrics["commitment_loss"] == pytest.approx(commitment.item(), rel=1e-4)


@pytest.mark.parametrize("codebook", [CodeBook((8, 5, 3)), BinaryCodeBook((8, 8, 8))])
def test_neighbors_are_one_step_away(codebook, monkeypatch):
    monkeypatch.setattr(losses, "TOKEN_NOISE", 0.5)
    codes = codebook.codes(torch.randint(0, 120, (4000,)))
    neighbors = codebook.neighbors(codes)
    factors = len(codebook.level_counts)
    alone = torch.where(torch.eye(factors, dtype=torch.bool)[:, None], neighbors, codes)
    steps = codebook.distance(alone, codes)
    assert steps.max() == 1
    assert codebook.distance(neighbors, codes).le(factors).all()
    assert 0.4 < (corrupt_codes(codes, codebook) != codes).float().mean() / steps.float().mean() < 0.6


def test_lfq_neighbors_flip_every_sign_as_often():
    codebook, codes = BinaryCodeBook((8,)), torch.full((6000, 1), 5)
    flipped = codebook.values(codes) != codebook.values(codebook.neighbors(codes))
    assert torch.equal(flipped.sum(-1), torch.ones(6000, dtype=torch.long))
    torch.testing.assert_close(flipped.float().mean(0), torch.full((3,), 1 / 3), atol=0.03, rtol=0)


def test_the_copy_bias_is_that_of_the_present_code():
    torch.manual_seed(0)
    config = AutoregressiveConfig(layers=1, width=16, heads=2, window=4, code_width=8)
    model = NextFrameNetwork(config, FrameSizes(LEVELS, "lfq", 4, 1, state_size=0, clip_length=4))
    torch.nn.init.zeros_(model.head.out.weight)
    codes = model.codebook.codes(torch.randint(0, 16**3, (2, 3, 16)))
    prediction, _ = model(codes, torch.zeros(2, 3, 0), Condition(torch.zeros(2, 3, 1, 16)))
    bias = model.head.out.bias
    present = prediction.logits - bias[: 3 * 16]
    gate = F.softplus(bias[3 * 16 :])
    expected = model.codebook.one_hot(codes) * gate[model.codebook.factor_of_logit]
    torch.testing.assert_close(present, expected)


def test_a_world_model_takes_its_quantizer_from_the_tokenizer(small_dataset, tmp_path):
    """Trained on LFQ tokens, saved, loaded and imagined in."""
    root = Path(small_dataset.root)
    config = tokenizer_config(quantizer="lfq", levels=list(LEVELS))
    tokenizer = run_training(config, root, tmp_path / "tokenizer", steps=4)
    logged = read_metrics(tokenizer)[-1]
    assert logged.keys() >= {"quantizer_loss", "token_entropy", "code_entropy", "commitment_loss"}
    folder = run_training(action_config(tokenizer), root, tmp_path / "action")
    model = load_model(folder, "action_world_model")
    assert (model.config.tokenizer.quantizer, tuple(model.config.tokenizer.levels)) == ("lfq", LEVELS)
    trained = load_model(tokenizer, "frame_tokenizer").tokenizer
    images = torch.rand(3, 1, 3, 32, 32)
    tokens = model.tokenizer.encode(images)
    assert torch.equal(tokens, trained.encode(images))
    imagined = model.step(model.start(Frames(tokens, torch.zeros(3, 8))), torch.zeros(3, 7))
    assert imagined.tokens.shape == tokens.shape
    assert imagined.tokens.max() < 16**3
    assert model.tokenizer.decode(imagined.tokens).shape == images.shape


def test_lfq_is_measured_in_float32_whatever_the_network_computes_in():
    torch.manual_seed(0)
    quantizer, vectors = LookupFreeQuantizer([16, 16]), torch.randn(4, 8, 4, 4)
    plain = quantizer(vectors)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = quantizer(vectors)
    assert mixed.metrics == plain.metrics
