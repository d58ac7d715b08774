"""A world model as three ONNX graphs, which a page without a server runs in the visitor's browser.

`start` reads the pictures and the state in which an episode begins, and its instruction if success depends
on it. `scene` encodes a frame, from which `step` then imagines one action after the other; after as many
steps as a training clip has, `scene` is run again on the newest frame. All shapes are constant.

What one graph returns and another needs has the same name in both. An output `next_…` is an input of the same
graph's next run.
"""

import logging
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.data.frames import Context
from lerobot_wmrl.world_models.anchored.dynamics import AnchoredDynamics
from lerobot_wmrl.world_models.anchored.network import EncodedScene, StateRollout
from lerobot_wmrl.world_models.layers import Rotation, attention
from lerobot_wmrl.world_models.modeling_world_model import ActionWorldModelRewardModel
from lerobot_wmrl.world_models.text import MAX_TOKENS

if TYPE_CHECKING:
    import onnx

GRAPHS: Final = ("start", "scene", "step")
NEXT: Final = "next_"
Tensors = dict[str, Tensor]
"""Named tensors of one imagination, between the graphs."""

BYTES: Final = "instruction_bytes"

FIRST_BYTE: Final = 3
"""ByT5's number of the byte 0."""

END: Final = 1
"""ByT5's number of the end of a text."""

LARGE: Final = 1024
"""Tensors of at least so many weights are stored in 16 bits."""

SCENE: Final = ("anchor", "tokens", "scene_keys_values", "summary", "local")
"""Names of the parts of an `EncodedScene`; the codes of its frame are the `anchor`."""

ROLLOUT: Final = ("state", "change", "hidden")
"""Names of the parts of a `StateRollout`."""


class WrittenMemory:
    """Attention along time to keys and values that are inputs, into which one new frame is written.

    Args:
        keys, values: (L, 1, 1, h, W, d) of the W frames of a clip.
        age: (1,), frames imagined since the scene was encoded.
    """

    def __init__(self, keys: Tensor, values: Tensor, age: Tensor) -> None:
        slots = torch.arange(keys.shape[-2])
        self.past, self.written = (keys, values), (slots == age)[:, None]
        self.mask, self.rotation = slots <= age, Rotation.at(age, keys.shape[-1])
        self.layers: list[tuple[Tensor, Tensor]] = []

    def attend(self, layer: int, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attend, as in `TemporalMemory`."""
        new = (self.rotation(key), value)
        keys, values = (
            torch.where(self.written, now, past[layer]) for now, past in zip(new, self.past, strict=True)
        )
        self.layers.append((keys, values))
        return attention(self.rotation(query), keys, values, self.mask)

    def written_past(self) -> tuple[Tensor, Tensor]:
        """Return keys and values with those of the new frame."""
        keys, values = zip(*self.layers, strict=True)
        return torch.stack(keys), torch.stack(values)


class Graph(nn.Module):
    """A part of a world model that reads and returns named tensors.

    Args:
        model: model with anchored dynamics.
        reads: names of the inputs, in their order.
    """

    def __init__(self, model: ActionWorldModelRewardModel, reads: Sequence[str]) -> None:
        super().__init__()
        self.model, self.reads = model, tuple(reads)
        self.network = cast(AnchoredDynamics, model.dynamics).network

    def compute(self, tensors: Tensors) -> Tensors:
        """Compute named tensors from those named in `reads`."""
        raise NotImplementedError

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Compute without names, as an exporter needs it."""
        return tuple(self.compute(dict(zip(self.reads, tensors, strict=True))).values())


class ReadStart(Graph):
    """The pictures (1, N, 3, S, S) in [0, 1] and the state (1, P) in which an episode begins.

    And the bytes of its instruction, if success depends on it, see `instruction_bytes`.
    """

    def __init__(self, model: ActionWorldModelRewardModel) -> None:
        reads = [BYTES] if model.config.reads_instructions else []
        super().__init__(model, ["pictures", "measured_state", *reads])

    def compute(self, tensors: Tensors) -> Tensors:
        tokenizer, pictures = self.model.tokenizer, tensors["pictures"]
        context = tokenizer.context(pictures)
        codes = self.network.codebook.codes(tokenizer.encode(pictures, context))[:, None]
        state = self.model.normalize_state(tensors["measured_state"])[:, None]
        read = {}
        if BYTES in tensors:
            classifier: Any = tokenizer.success
            ids = tensors[BYTES]
            read["instruction_weights"] = classifier.instructions.weights(ids, (ids != 0).long())
        return {"codes": codes, "state": state, **numbered("context", context.maps), **read}


class EncodeScene(Graph):
    """A frame as steps need it: of these codes (1, 1, S, C) and this state (1, 1, P), normalised."""

    def __init__(self, model: ActionWorldModelRewardModel, contexts: int) -> None:
        super().__init__(model, ["codes", "state", *(["context_0"] if contexts else [])])

    def compute(self, tensors: Tensors) -> Tensors:
        context = Context((tensors["context_0"],)) if "context_0" in tensors else Context()
        scene, rollout = self.network.encode(tensors["codes"], tensors["state"], context)
        kept = {"anchor": scene.codes, **dict(zip(SCENE[1:], scene[1:], strict=True))}
        shape = (len(self.network.trajectory), 1, 1, self.network.heads, self.network.window)
        keys = torch.zeros(*shape, self.network.head_width)
        begun = {"change": rollout.change, "hidden": rollout.hidden}
        return {**kept, **begun, "keys": keys, "values": torch.zeros_like(keys)}


class ImagineStep(Graph):
    """An action (1, A) in the dataset's units → the next frame.

    `pixels` (N, S, S, 4) uint8, red, green, blue and opaque; `done_probability`, `token_entropy` (1,).
    """

    def __init__(self, model: ActionWorldModelRewardModel, contexts: int) -> None:
        maps = [f"context_{index}" for index in range(1, contexts)]
        read = ["instruction_weights"] if model.config.reads_instructions else []
        super().__init__(model, ["action", "age", *SCENE, *ROLLOUT, "keys", "values", *maps, *read])

    def compute(self, tensors: Tensors) -> Tensors:
        network, codebook = self.network, self.network.codebook
        memory = WrittenMemory(tensors["keys"], tensors["values"], tensors["age"])
        condition = self.model.encode_actions(tensors["action"][:, None], tensors.get("instruction_weights"))
        scene = EncodedScene(*(tensors[name] for name in SCENE))
        rollout = StateRollout(*(tensors[name] for name in ROLLOUT))
        prediction, rollout = network.follow(
            scene, rollout, condition.mean(), memory, None, condition.instruction_weights
        )
        codes = codebook.most_likely(prediction.logits)
        maps = [tensors[name] for name in self.reads if name.startswith("context")]
        context = Context((torch.zeros_like(maps[0]), *maps)) if maps else Context()
        images = self.model.tokenizer.decode(codebook.tokens(codes[:, 0]), context)[0]
        keys, values = memory.written_past()
        return {
            "pixels": opaque_pixels(images),
            "done_probability": prediction.done_logit[:, 0].sigmoid(),
            "token_entropy": codebook.entropy(prediction.logits[:, 0]),
            "codes": codes,
            **{f"{NEXT}{name}": each for name, each in zip(ROLLOUT, rollout, strict=True)},
            f"{NEXT}keys": keys,
            f"{NEXT}values": values,
        }


def instruction_bytes(instruction: str) -> np.ndarray:
    """Return an instruction as ByT5 reads it: its bytes, the end, and zeros up to `MAX_TOKENS`. (1, L) int64

    Raises:
        ValueError: it is too long.
    """
    ids = [FIRST_BYTE + byte for byte in instruction.encode()] + [END]
    if len(ids) > MAX_TOKENS:
        raise ValueError(f"task: an instruction of {len(ids) - 1} bytes; at most {MAX_TOKENS - 1} are read")
    return np.array([ids + [0] * (MAX_TOKENS - len(ids))])


def numbered(name: str, tensors: Sequence[Tensor]) -> Tensors:
    """Number tensors of a name."""
    return {f"{name}_{index}": tensor for index, tensor in enumerate(tensors)}


def opaque_pixels(images: Tensor) -> Tensor:
    """Images (N, 3, S, S) in [0, 1] → bytes (N, S, S, 4), as a canvas takes them."""
    colours = (images * 255).round().movedim(1, -1)
    return torch.cat([colours, torch.full_like(colours[..., :1], 255)], -1).to(torch.uint8)


def input_names(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Return a graph's outputs under the names by which they are read."""
    return {name.removeprefix(NEXT): each for name, each in tensors.items()}


def export_graphs(model: ActionWorldModelRewardModel, folder: Path) -> None:
    """Write `start.onnx`, `scene.onnx` and `step.onnx`.

    Args:
        model: model on the CPU.
        folder: that exists.

    Raises:
        FieldError: its dynamics are not anchored.
    """
    kind = model.config.dynamics.type
    if kind != "anchored":
        raise FieldError(
            "world_model.path",
            model.config.pretrained_path,
            f"has {kind} dynamics; only anchored ones can be exported",
            "train one with --model.dynamics.type=anchored, or serve the page instead",
        )
    tokenizer_config = model.config.tokenizer
    tensors: Tensors = {
        "pictures": torch.rand(
            1, len(tokenizer_config.cameras), 3, tokenizer_config.image_size, tokenizer_config.image_size
        ),
        "measured_state": model.state_mean[None].clone(),
        "action": model.action_mean[None].clone(),
        "age": torch.zeros(1, dtype=torch.long),
        BYTES: torch.from_numpy(instruction_bytes("push")),
    }
    start = ReadStart(model)
    contexts = len(model.tokenizer.context(tensors["pictures"]).maps)
    logging.getLogger("onnx_ir").setLevel(logging.ERROR)
    graphs = {"start": start, "scene": EncodeScene(model, contexts), "step": ImagineStep(model, contexts)}
    for name, graph in graphs.items():
        inputs = {read: tensors[read] for read in graph.reads}
        with torch.no_grad(), warnings.catch_warnings(action="ignore"):  # of torch's, about torch's own code
            outputs = graph.eval().compute(inputs)
            program = torch.onnx.export(
                graph,
                tuple(inputs.values()),
                input_names=list(inputs),
                output_names=list(outputs),
                dynamo=True,
                verbose=False,
            )
        assert program is not None
        (folder / f"{name}.onnx").write_bytes(in_float16(program.model_proto).SerializeToString())
        tensors |= input_names(outputs)


def in_float16(proto: "onnx.ModelProto") -> "onnx.ModelProto":
    """Store a graph's weights in 16 bits. They are made 32 bits again when the graph is loaded."""
    from onnx import TensorProto, helper, numpy_helper

    graph = proto.graph
    large = [
        each
        for each in graph.initializer
        if each.data_type == TensorProto.FLOAT and np.prod(each.dims) >= LARGE
    ]
    for index, weights in enumerate(large):
        name = f"{weights.name}_half"
        half = numpy_helper.to_array(weights).astype(np.float16)
        graph.initializer.remove(weights)
        graph.initializer.append(numpy_helper.from_array(half, name))
        graph.node.insert(index, helper.make_node("Cast", [name], [weights.name], to=TensorProto.FLOAT))
    return proto


class ExportedWorldModel:
    """The graphs in a folder, run here as a page runs them there.

    Args:
        folder: folder with the three graphs.
        window: steps after which a scene is encoded anew.
    """

    def __init__(self, folder: Path, window: int) -> None:
        import onnxruntime

        self.window = window
        self.graphs = {name: onnxruntime.InferenceSession(folder / f"{name}.onnx") for name in GRAPHS}

    def begin(self, pictures: np.ndarray, state: np.ndarray, instruction: str) -> None:
        """Begin in pictures (1, N, 3, S, S), in [0, 1], and a state (1, P)."""
        self.tensors: dict[str, np.ndarray] = {
            "pictures": pictures,
            "measured_state": state,
            BYTES: instruction_bytes(instruction),
        }
        self.imagined = 0
        self._run("start")

    def step(self, action: np.ndarray) -> Mapping[str, np.ndarray]:
        """Imagine the frame after an action (1, A). Return all tensors, see `ImagineStep`."""
        age = self.imagined % self.window
        if age == 0:
            self._run("scene")
        self.tensors |= {"action": action, "age": np.array([age])}
        self._run("step")
        self.imagined += 1
        return self.tensors

    def _run(self, name: str) -> None:
        graph = self.graphs[name]
        outputs = graph.run(None, {each.name: self.tensors[each.name] for each in graph.get_inputs()})
        names = (each.name for each in graph.get_outputs())
        self.tensors |= input_names(dict(zip(names, outputs, strict=True)))
