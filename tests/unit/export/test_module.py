"""Any torch module with `encode` and `step` is exported, or refused in one line."""

import io
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from edge.core.perception import PerceptionParameters
from edge.drivers.registry import load_policy
from edge.policy.bundle import Bundle, Training, load_bundle, write_bundle
from edge.policy.family import Neighbourhood, Observation, verified
from edge.policy.golden import GOLDEN
from edge.policy.network.policy import NetworkPolicy
from export.contract import ModuleError
from export.module import export_module, load_module, network_bundle
from export.parameters import PolicyMessages, PolicyParameters
from tests.conftest import ROOT

PARAMETERS = PolicyParameters(
    PerceptionParameters(
        world_size=512, local_map_size=256, sensor_size=64, communication_range=256.0
    ),
    Training(max_speed=5.0, time_step=0.2),
)
MESSAGE = 16


class Observing(nn.Module):
    """A small CNN; what its step does is a subclass's."""

    message_size = MESSAGE

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(3)
        self.cnn = nn.Sequential(
            nn.Conv2d(4, 8, 3, stride=2), nn.BatchNorm2d(8), nn.ReLU(), nn.Flatten(),
            nn.Linear(8 * 15 * 15, 14),
        )  # fmt: skip
        self.key = nn.Linear(MESSAGE + 5, MESSAGE)
        self.query = nn.Linear(16, MESSAGE)
        self.act = nn.Linear(2 * MESSAGE, 2)

    def encode(self, maps: Tensor, position: Tensor) -> Tensor:
        return torch.cat([self.cnn(maps[None])[0], position])

    def keys(self, messages: Tensor, positions: Tensor, velocities: Tensor, ages: Tensor) -> Tensor:
        keys: Tensor = self.key(
            torch.cat([messages, positions / 256.0, velocities / 5.0, ages[:, None]], dim=1)
        )
        return keys


class Reduction(Observing):
    """Sums of messages, as the paper's network."""

    def step(self, features: Tensor, messages: Tensor, degree: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        received = messages.sum(dim=0) / degree.clamp(min=1.0)
        return self.act(torch.cat([query, received])), torch.tanh(query + received)


class Everything(Observing):
    """Attention of two heads, memory, and three denoising steps, from all inputs."""

    noise: Tensor
    memory_size = 12
    channels = ("importance", "neighbours_x", "neighbours_y", "explored", "obstacles")
    image_size = 24

    def __init__(self) -> None:
        super().__init__()
        self.cnn[0] = nn.Conv2d(5, 8, 3, stride=2)
        self.cnn[4] = nn.Linear(8 * 11 * 11, 14)
        self.attention = nn.MultiheadAttention(MESSAGE, num_heads=2, batch_first=True)
        self.near = nn.Linear(2, 16)
        self.gru = nn.GRUCell(2 * MESSAGE, 12)
        self.denoise = nn.Linear(12 + 2 + 1, 2)
        self.register_buffer("noise", torch.randn(2))

    def encode(  # type: ignore[override]
        self, maps: Tensor, position: Tensor, velocity: Tensor, neighbours: Tensor
    ) -> Tensor:
        near: Tensor = torch.relu(self.near(neighbours / 256.0)).sum(dim=0) + self.near(velocity)
        return super().encode(maps, position) + near

    def step(
        self,
        features: Tensor,
        messages: Tensor,
        positions: Tensor,
        velocities: Tensor,
        ages: Tensor,
        memory: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        query = self.query(features)[None]
        keys = torch.cat([query, self.keys(messages, positions, velocities, ages)])[None]
        received = self.attention(query[None], keys, keys, need_weights=False)[0][0, 0]
        memory = self.gru(torch.cat([query[0], received])[None], memory[None])[0]
        action = self.noise
        for level in range(3, 0, -1):
            given = torch.cat([memory, action, action.new_tensor([level / 3.0])])
            action = action - 0.5 * self.denoise(given)
        return action, received, memory


class Ordered(Observing):
    """Listens to the neighbour with the smallest id most."""

    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        weights = 0.5 ** torch.arange(messages.shape[0], dtype=features.dtype)
        query = self.query(features)
        return self.act(torch.cat([query, weights @ messages])), query


class KnownOrder(Ordered):
    depends_on_order = True


class ThreeNeighbours(Observing):
    def __init__(self) -> None:
        super().__init__()
        self.three = nn.Linear(3 * MESSAGE, MESSAGE)

    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        return self.act(torch.cat([query, self.three(messages.flatten())])), query


class NoneIsNan(Observing):
    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        return self.act(torch.cat([query, messages.mean(dim=0)])), query


class Draws(Observing):
    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        received = messages.sum(dim=0) + 0.0 * torch.randn(MESSAGE)
        return self.act(torch.cat([query, received])), query


class Shouts(Observing):
    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        return self.act(torch.cat([query, query])), 1e6 * query


class DecidesInPython(Observing):
    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        if len(messages) > 10:
            query = -query
        return self.act(torch.cat([query, query])), query


class DecidesByValue(Observing):
    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        if float(features.sum()) > 0.0:
            query = -query
        return self.act(torch.cat([query, query])), query


class Keeps(Observing):
    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        self.before = getattr(self, "before", 0.0) + 0.1
        query = self.query(features) + self.before
        return self.act(torch.cat([query, messages.sum(dim=0)])), query


class Grows(Observing):
    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        return self.act(torch.cat([query, query])), query + 10.0 * messages.sum(dim=0)


class TwoFeatures(Reduction):
    def encode(self, position: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        return position, position


class MemoryNotTaken(Reduction):
    memory_size = 3


class OneRate(Reduction):
    rates_hz = 5.0


class OnlyOthers(Observing):
    """An encoder over the neighbours, without the robot's own token."""

    def __init__(self) -> None:
        super().__init__()
        self.others = nn.TransformerEncoderLayer(MESSAGE, 2, 32, batch_first=True)

    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        received = self.others(messages[None])[0].sum(dim=0)
        return self.act(torch.cat([query, received])), query


class Scalar(Reduction):
    """Takes the number of neighbours as a number, not as a list of one."""

    def step(self, features: Tensor, messages: Tensor, degree: Tensor) -> tuple[Tensor, Tensor]:
        share = torch.stack([degree, features[0]])
        return share[1:] * degree + share, torch.tanh(self.query(features))


class DrawsInConstructor(Reduction):
    """The checkpoint does not have its noise."""

    def __init__(self) -> None:
        super().__init__()
        self.noise = torch.randn(2, generator=torch.Generator().manual_seed(next(_SEEDS)))

    def step(self, features: Tensor, messages: Tensor, degree: Tensor) -> tuple[Tensor, Tensor]:
        action, message = super().step(features, messages, degree)
        return action + self.noise, message


_SEEDS = itertools.count()


class UnknownInput(Observing):
    def step(self, features: Tensor, battery: Tensor) -> tuple[Tensor, Tensor]:
        return self.act(self.query(features)), battery


class NoMessage(Observing):
    def step(self, features: Tensor, messages: Tensor) -> Tensor:
        query = self.query(features)
        action: Tensor = self.act(torch.cat([query, messages.sum(dim=0)]))
        return action


class OtherMessage(Observing):
    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        query = self.query(features)
        return self.act(torch.cat([query, messages.sum(dim=0)])), query[:3]


class Silent(nn.Module):
    """Sends nothing, and decides by where its neighbours are, in float32 alone."""

    message_size = 0

    def encode(self, position: Tensor, neighbours: Tensor) -> Tensor:
        away = -(neighbours / neighbours.norm(dim=1, keepdim=True).clamp(min=1.0)).sum(dim=0)
        return torch.cat([away, position - 0.5])

    def step(self, features: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
        return (features[:2] - features[2:]).float(), features.new_zeros(0)


def export(module: nn.Module, parameters: PolicyParameters = PARAMETERS) -> Bundle:
    return network_bundle(module, parameters, "network", {})


_EXPORTED: dict[str, Bundle] = {}


def exported(module: type[nn.Module]) -> Bundle:
    """The module's bundle, made once."""
    name = module.__name__
    if name not in _EXPORTED:
        _EXPORTED[name] = export(module())
    return _EXPORTED[name]


def neighbourhood(count: int, message_size: int, seed: int = 0) -> Neighbourhood:
    rng = np.random.default_rng(seed)
    return Neighbourhood(
        robot_ids=tuple(range(2, count + 2)),
        payloads=list(rng.normal(size=(count, message_size)).astype(np.float16)),
        positions=rng.uniform(-256.0, 256.0, (count, 2)).astype(np.float32),
        velocities=rng.uniform(-5.0, 5.0, (count, 2)).astype(np.float32),
        ages_s=rng.uniform(0.0, 0.8, count).astype(np.float32),
        degree=count + 1,
    )


@pytest.mark.parametrize("module", [Reduction, Everything, KnownOrder, Silent, Scalar])
def test_a_robot_computes_what_torch_computes(module: type[nn.Module], tmp_path: Path) -> None:
    network = module().eval().requires_grad_(False)
    write_bundle(exported(module), tmp_path / "bundle")
    policy = load_policy(load_bundle(tmp_path / "bundle"))
    assert isinstance(policy, NetworkPolicy)
    assert verified(policy).problem is None
    agent, rng = policy.agent(), np.random.default_rng(1)
    memory = torch.zeros(policy.network.memory_size)
    for count in (0, 5, 1, 0, 17):
        local_map = rng.random((256, 256), np.float32)
        others = rng.uniform(0.0, 512.0, (count, 2))
        observation = Observation(np.array([200.0, 90.0]), local_map, others, np.array([1.0, 2.0]))
        perceived = agent.observe(observation)
        inputs = {name: torch.from_numpy(perceived.inputs[name]) for name in policy.network.encode}
        features = network.encode(**inputs)  # type: ignore[operator]
        np.testing.assert_allclose(perceived.features, features, rtol=1e-4, atol=1e-5)
        around = neighbourhood(count, policy.message_size, count)
        step = agent.step(perceived.features, around)
        given = {
            "features": features,
            "messages": torch.from_numpy(np.array(around.payloads, np.float32)).reshape(
                count, policy.message_size
            ),
            "positions": torch.from_numpy(around.positions),
            "velocities": torch.from_numpy(around.velocities),
            "ages": torch.from_numpy(around.ages_s),
            "degree": torch.tensor(float(around.degree)),
            "memory": memory,
        }
        action, message, *new = network.step(**{n: given[n] for n in policy.network.step})  # type: ignore[operator]
        np.testing.assert_allclose(step.velocity, action, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(step.payload, message, rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(step.inputs["memory"].shape, memory.shape)
        np.testing.assert_allclose(step.inputs["memory"], memory, rtol=1e-4, atol=1e-5)
        memory = new[0] if new else memory
        again = policy.logged_step(perceived.features, around, step.inputs)
        np.testing.assert_array_equal(again.velocity, step.velocity)
        np.testing.assert_array_equal(policy.logged_features(perceived.inputs), perceived.features)
    agent.reset()
    first = agent.step(perceived.features, around)
    assert not first.inputs["memory"].any()


def test_the_manifest_names_all_that_the_graphs_take_and_give() -> None:
    manifest = exported(Everything).manifest
    assert manifest.family == "network"
    assert manifest.perception is not None and manifest.perception.unseen_as_nan
    network = manifest.parameters
    assert network["encode"] == {
        "maps": {"shape": [5, 24, 24], "unit": "importance; communication ranges; share of a cell"},
        "position": {"shape": [2], "unit": "world sizes"},
        "velocity": {"shape": [2], "unit": "model units/s"},
        "neighbours": {"shape": ["neighbours", 2], "unit": "model units"},
    }
    assert list(network["step"]) == [  # type: ignore[call-overload]
        "ages", "features", "memory", "messages", "positions", "velocities",
    ]  # fmt: skip
    assert network["action"] == {"shape": [2], "unit": "model units/s"}
    assert network["rates"] == {"encode_hz": 5.0, "step_hz": 2.5}
    assert (network["message_size"], network["memory_size"]) == (16, 12)
    assert network["order"] == "any"
    assert exported(KnownOrder).manifest.parameters["order"] == "by robot id"


def test_the_same_module_gives_the_same_bundle_which_names_no_file_of_this_machine() -> None:
    bundle = exported(Everything)
    assert bundle.id == export(Everything()).id
    for content in bundle.files.values():
        assert str(Path(__file__).parent).encode() not in content
        assert b"test_module" not in content


def test_golden_outputs_are_with_no_one_three_and_many_neighbours() -> None:
    golden = np.load(io.BytesIO(exported(Everything).files[GOLDEN]))
    steps = [golden[f"step/{case}/messages"].shape for case in range(5)]
    assert steps == [(0, 16), (0, 16), (1, 16), (3, 16), (30, 16)]
    assert not golden["step/0/memory"].any() and golden["step/4/memory"].any()


@pytest.mark.parametrize(
    ("module", "problem"),
    [
        (Ordered, "step with 3 neighbours: the order of the neighbours changes the action: make it "
                  "independent, or set depends_on_order = True"),
        (ThreeNeighbours, "step with no neighbours: RuntimeError: mat1 and mat2 shapes cannot"),
        (NoneIsNan, "step with no neighbours: gives NaN or infinity"),
        (Draws, "step: draws random numbers"),
        (Shouts, "step: a message has the value .*: robots refuse more than 65504"),
        (DecidesInPython, r"fixed number of neighbours: use messages.shape\[0\]"),
        (DecidesByValue, "step: torch cannot trace it: it decides in Python by the value"),
        (Keeps, "step: gives another result for the same inputs: what it keeps belongs into"),
        (Grows, "step: a message has the value .*: robots refuse more than 65504"),
        (TwoFeatures, "encode gives 2 tensors: must give a tensor of one dimension"),
        (MemoryNotTaken, "memory_size = 3, but step takes no memory"),
        (OneRate, "OneRate: rates_hz = 5.0: must be two numbers"),
        (OnlyOthers, "step with no neighbours: onnxruntime cannot run it: let the robot attend to"),
        (UnknownInput, "step takes 'battery': known are features, messages, positions"),
        (NoMessage, r"step with no neighbours: gives shapes \(2,\): must be action \(2,\), "
                    r"message \(16,\)"),
        (OtherMessage, r"gives shapes \(2,\), \(3,\): must be action \(2,\), message \(16,\)"),
        (nn.ReLU, "ReLU: message_size = None: must be an attribute with an integer"),
    ],
)  # fmt: skip
def test_a_module_that_robots_cannot_fly_is_refused_in_one_line(
    module: type[nn.Module], problem: str
) -> None:
    with pytest.raises(ModuleError, match=problem) as error:
        export(module())
    assert "\n" not in str(error.value)


def test_a_message_beyond_the_manifest_limit_is_refused() -> None:
    limited = PolicyParameters(
        PARAMETERS.perception, PARAMETERS.training, PolicyMessages(payload_limit=0.01)
    )
    with pytest.raises(ModuleError, match=r"robots refuse more than 0\.01"):
        export(Reduction(), limited)


def test_numbers_that_only_the_constructor_knows_are_refused(tmp_path: Path) -> None:
    torch.save(DrawsInConstructor().state_dict(), tmp_path / "trained.pt")
    parameters = ROOT / "examples" / "networks" / "memory.toml"
    reference = f"{__name__}:DrawsInConstructor"
    with pytest.raises(ModuleError, match="constructor draws numbers that the checkpoint does not"):
        export_module(reference, tmp_path / "trained.pt", parameters)
    state = Reduction().state_dict()
    state["act.bias"][0] = torch.nan
    torch.save(state, tmp_path / "nan.pt")
    with pytest.raises(ValueError, match=r"nan\.pt: act\.bias: has values that are not finite"):
        load_module(f"{__name__}:Reduction", tmp_path / "nan.pt")


def test_a_module_is_found_by_its_file_or_its_package(tmp_path: Path) -> None:
    module = Reduction()
    with torch.no_grad():
        module.act.bias.fill_(0.25)
    checkpoint = tmp_path / "trained.pt"
    torch.save({"state_dict": module.state_dict(), "epoch": 3}, checkpoint)
    for reference in (f"{__file__}:Reduction", f"{__name__}:Reduction"):
        loaded = load_module(reference, checkpoint)
        assert torch.equal(loaded.act.bias, module.act.bias)  # type: ignore[union-attr, arg-type]
    for reference, given, problem in (
        ("nowhere.py:Reduction", checkpoint, "nowhere.py is not a file"),
        ("nowhere_to_find:Reduction", checkpoint, "No module named"),
        (f"{__name__}:Absent", checkpoint, "has no attribute 'Absent'"),
        (f"{__name__}:MESSAGE", checkpoint, "'int' object is not callable"),
        (f"{__name__}:Reduction", None, "has weights: give --checkpoint"),
        (f"{__name__}:Everything", checkpoint, "does not fit"),
    ):
        with pytest.raises(ValueError, match=problem):
            load_module(reference, given)
    assert isinstance(load_module(f"{__name__}:Silent", None), Silent)
