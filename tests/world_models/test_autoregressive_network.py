import torch
from torch.nn import functional as F
from vector_quantize_pytorch import FSQ

from lerobot_wmrl.world_models.autoregressive.configuration import AutoregressiveConfig
from lerobot_wmrl.world_models.autoregressive.network import NextFrameNetwork
from lerobot_wmrl.world_models.codebook import CodeBook
from lerobot_wmrl.world_models.condition import Condition
from lerobot_wmrl.world_models.layers import FrameSizes

LEVELS = (8, 5, 3)


def network() -> NextFrameNetwork:
    torch.manual_seed(0)
    config = AutoregressiveConfig(
        layers=2, width=16, heads=2, window=4, code_width=8, conditioning="cross_attention"
    )
    sizes = FrameSizes(LEVELS, "fsq", grid=4, num_cameras=2, state_size=3, clip_length=4)
    return NextFrameNetwork(config, sizes)


def test_codes_are_those_of_the_quantizer_and_make_the_token_again():
    codebook, quantizer = CodeBook(LEVELS), FSQ(list(LEVELS))
    tokens = torch.arange(8 * 5 * 3)
    codes = codebook.codes(tokens)
    assert torch.equal(codes, quantizer.indices_to_level_indices(tokens).long())
    assert torch.equal(codebook.tokens(codes), tokens)


def test_factorised_cross_entropy_equals_that_of_the_product_distribution():
    codebook = CodeBook(LEVELS)
    tokens = torch.arange(8 * 5 * 3)
    logits = torch.randn(1, sum(LEVELS), dtype=torch.float64).expand(len(tokens), -1)
    every = codebook.cross_entropy(logits, codebook.codes(tokens))
    torch.testing.assert_close(every.neg().exp().sum(), torch.ones((), dtype=torch.float64))
    first = F.log_softmax(logits[0, :8], 0)[3] + F.log_softmax(logits[0, 8:13], 0)[1]
    first = first + F.log_softmax(logits[0, 13:], 0)[2]
    token = codebook.tokens(torch.tensor([3, 1, 2]))
    torch.testing.assert_close(every[token], -first)


def test_the_most_likely_code_is_that_of_each_factor():
    logits = torch.tensor([0.0, 1.0, 2.0, -1.0, 5.0, 3.0, 4.0])
    assert CodeBook((4, 3)).most_likely(logits.expand(9, 7)).tolist() == [[2, 0]] * 9


def test_an_untrained_network_prefers_to_leave_the_frame_as_it_is():
    model = network()
    codes = model.codebook.codes(torch.randint(0, 8 * 5 * 3, (2, 3, 32)))
    prediction, _ = model(codes, torch.zeros(2, 3, 3), Condition(torch.zeros(2, 3, 1, 16)))
    kept = model.codebook.most_likely(prediction.logits) == codes
    assert kept.float().mean() > 0.6


def test_every_input_reaches_the_prediction():
    model = network()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    state = torch.randn(1, 2, 3, requires_grad=True)
    condition = torch.randn(1, 2, 1, 16, requires_grad=True)
    codes = model.codebook.codes(torch.randint(0, 120, (1, 2, 32)))
    prediction, _ = model(codes, state, Condition(condition))
    for output in (prediction.logits, prediction.done_logit, prediction.state):
        gradients = torch.autograd.grad(output[:, 1].sum(), (state, condition), retain_graph=True)
        assert all(gradient[:, 0].abs().sum() > 0 for gradient in gradients)
