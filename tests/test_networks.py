"""Declared networks act as torch's do, whatever the batch; files that are not such a network are refused."""

import json
import re
import shutil

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file
from torch import nn

from hipg_bench import make, task_spec
from hipg_bench.errors import BundleError
from hipg_bench.policies.attention import Group
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.network import AttentionSpec, GRUSpec, NetworkSpec, load_network, save_network

LAYERS = {"layer0.weight": (6, 5), "layer0.bias": (6,), "layer1.weight": (4, 6), "layer1.bias": (4,)}


def tensors(lead=(), **changed):
    """A network from 5 observed numbers to 4 outputs; ``lead`` is (N,) for weights per agent."""
    chance = np.random.default_rng(3)
    shapes = {name: (*lead, *shape) for name, shape in LAYERS.items()} | changed
    return {
        "observation.mean": chance.normal(size=5),
        "observation.scale": chance.uniform(0.5, 2, size=5),
        **{name: chance.normal(size=shape) for name, shape in shapes.items()},
    }


def by_hand(content, spec, observation, agent):
    """One agent's action, layer by layer."""
    own = {name: array.astype(np.float32).astype(np.float64) for name, array in content.items()}
    if own["layer0.bias"].ndim == 2:
        own = {name: array[agent] if name.startswith("layer") else array for name, array in own.items()}
    seen = np.clip((observation - own["observation.mean"]) / own["observation.scale"], -10, 10)
    hidden = own["layer0.weight"] @ seen + own["layer0.bias"]
    hidden = np.tanh(hidden) if spec.activation == "tanh" else np.maximum(hidden, 0)
    out = own["layer1.weight"] @ hidden + own["layer1.bias"]
    if spec.head == "bins":
        places = [int(np.argmax(out[start : start + spec.bins])) for start in range(0, 4, spec.bins)]
        return spec.reach * np.array([np.linspace(-1, 1, spec.bins)[place] for place in places])
    if spec.head == "linear":
        return spec.reach * out
    return spec.reach * (np.tanh(out) if spec.head == "tanh" else np.clip(out, -1, 1))


SPECS = [
    NetworkSpec(),
    NetworkSpec(head="linear"),
    NetworkSpec(activation="relu", head="tanh", reach=5.0),
    NetworkSpec(activation="relu", head="bins", bins=2),
    NetworkSpec(activation="relu", head="bins", bins=4),
]


@pytest.mark.parametrize("lead", [(), (3,)], ids=["shared", "apart"])
@pytest.mark.parametrize("spec", SPECS, ids=str)
def test_a_policy_file_acts_as_it_declares(tmp_path, spec, lead):
    content = tensors(lead)
    save_network(content, tmp_path / "one.safetensors", spec)
    policy = load_network(tmp_path / "one.safetensors")
    observation = np.random.default_rng(4).normal(0, 3, size=(6, 3, 5)).astype(np.float32)
    assert policy.initial_state(0, np.arange(6), 3) is None
    action, _ = policy.act(observation, None, np.ones((6, 3), bool))
    expected = np.array([[by_hand(content, spec, seen[i], i) for i in range(3)] for seen in observation])
    assert policy.action_size == expected.shape[-1]
    np.testing.assert_allclose(action, expected, atol=1e-5)
    assert (action * 2**16 == np.round(action * 2**16)).all()
    alone, _ = policy.act(observation[2:3], None, np.ones((1, 3), bool))
    np.testing.assert_array_equal(alone, action[2:3])


def test_equal_values_take_the_first_bin(tmp_path):
    content = tensors() | {"layer1.weight": np.zeros((4, 6)), "layer1.bias": np.full(4, 0.3)}
    save_network(content, tmp_path / "one.safetensors", NetworkSpec(head="bins", bins=4))
    policy = load_network(tmp_path / "one.safetensors")
    action, _ = policy.act(np.ones((1, 1, 5), np.float32), None, np.ones((1, 1), bool))
    assert action.tolist() == [[[-1.0]]]


def test_the_same_network_is_the_same_file(tmp_path):
    for name in ("a", "b"):
        save_network(tensors(), tmp_path / name, SPECS[1])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_file_of_the_first_format_is_a_shared_tanh_network(tmp_path):
    content = {name: array.astype(np.float32) for name, array in tensors().items()}
    save_file(content, tmp_path / "old.safetensors", {"format": "hipg-mlp-1"})
    policy = load_network(tmp_path / "old.safetensors")
    assert policy.spec == NetworkSpec()
    action, _ = policy.act(np.ones((1, 1, 5), np.float32), None, np.ones((1, 1), bool))
    np.testing.assert_allclose(action[0, 0], by_hand(content, NetworkSpec(), np.ones(5), 0), atol=1e-5)


def test_weights_of_three_agents_are_not_a_team_of_four(tmp_path):
    save_network(tensors((3,)), tmp_path / "one.safetensors")
    with pytest.raises(BundleError, match="weights for 3 agents, the task 4"):
        load_network(tmp_path / "one.safetensors").initial_state(0, np.arange(2), 4)


@pytest.mark.parametrize(
    ("declared", "changed", "reason"),
    [
        (
            "hipg-mlp-3 {}",
            {},
            "'hipg-mlp-1', 'hipg-mlp-2', 'hipg-gru-1', 'hipg-attention-1' are allowed, got 'hipg-mlp-3'",
        ),
        ("", {}, "are allowed, got ''"),
        ("hipg-mlp-2", {}, "its spec '' is refused"),
        ("hipg-mlp-2 []", {}, "its spec '[]' is refused"),
        ('hipg-mlp-2 {"activation": "gelu"}', {}, "activation = 'gelu' is refused"),
        ('hipg-mlp-2 {"activaton": "relu"}', {}, "no field 'activaton'; did you mean 'activation'?"),
        ('hipg-mlp-2 {"head": "bins"}', {}, "2 or more bins belong to the head 'bins', got 0"),
        ('hipg-mlp-2 {"bins": 4}', {}, "got 4, 'mean'"),
        ('hipg-mlp-2 {"head": "bins", "bins": 3}', {}, "4 outputs are not a multiple of 3 bins"),
        ('hipg-mlp-2 {"reach": 0}', {}, "reach = 0"),
        (
            "hipg-mlp-2 {}",
            {"layer1.weight": (3, 4, 6)},
            "layer1 is (3, 4, 6), (4,); expected (out, 6), (out,)",
        ),
        (
            "hipg-mlp-2 {}",
            {"layer0.weight": (3, 6, 5), "layer0.bias": (3, 6)},
            "expected (3, out, 6), (3, out,)",
        ),
        (
            "hipg-mlp-2 {}",
            {"layer0.weight": (2, 3, 6, 5), "layer0.bias": (2, 3, 6)},
            "layer0 is (2, 3, 6, 5)",
        ),
        ("hipg-mlp-2 {}", {"layer1.weight": (0, 6), "layer1.bias": (0,)}, "layer1 is (0, 6)"),
        ("hipg-mlp-2 {}", {"layer1.weight": (6,), "layer1.bias": ()}, "layer1 is (6,), ()"),
        ("hipg-mlp-2 {}", {"layer2.weight": (4, 4)}, "tensors"),
    ],
)
def test_malformed_policy_files_are_refused(tmp_path, declared, changed, reason):
    content = {name: np.asarray(array, np.float32) for name, array in tensors(**changed).items()}
    save_file(content, tmp_path / "one.safetensors", {"format": declared})
    with pytest.raises(BundleError) as caught:
        load_network(tmp_path / "one.safetensors")
    assert reason in str(caught.value)


def plain(module, prefix=""):
    """A torch module's tensors by name."""
    return {prefix + name: tensor.detach().numpy() for name, tensor in module.named_parameters()}


def normaliser(size):
    chance = np.random.default_rng(7)
    return {
        "observation.mean": chance.normal(size=size),
        "observation.scale": chance.uniform(0.5, 2, size=size),
    }


def whitened(tensors, observation):
    """What torch's networks get: the same normalisation, in float32."""
    seen = (observation - tensors["observation.mean"]) / tensors["observation.scale"]
    return torch.tensor(np.clip(seen, -10, 10), dtype=torch.float32)


@pytest.fixture(scope="module")
def gru_file(tmp_path_factory):
    """A file, its tensors and torch's own modules: 5 numbers seen, 8 encoded, 6 remembered, 4 put out."""
    torch.manual_seed(1)
    encoder, unit, first, last = (
        nn.Linear(5, 8),
        nn.GRU(8, 6, batch_first=True),
        nn.Linear(6, 7),
        nn.Linear(7, 4),
    )
    tensors = normaliser(5) | plain(encoder, "encoder0.") | plain(first, "layer0.") | plain(last, "layer1.")
    tensors |= {f"gru.{name.removesuffix('_l0')}": one for name, one in plain(unit).items()}
    path = tmp_path_factory.mktemp("gru") / "one.safetensors"
    save_network(tensors, path, GRUSpec(activation="relu", head="tanh"))
    return path, tensors, (encoder, unit, first, last)


def played(policy, observation):
    """(B, T, N, A) of what a policy does, and that its memory is left as it was."""
    batch, _, team = observation.shape[:3]
    memory, done = policy.initial_state(0, np.arange(batch), team), []
    for seen in observation.swapaxes(0, 1):
        before = None if memory is None else memory.copy()
        action, after = policy.act(seen, memory, np.ones((batch, team), bool))
        np.testing.assert_array_equal(memory, before)
        memory = after
        done.append(action)
    return np.stack(done, axis=1)


def test_a_gru_is_torchs(gru_file):
    path, tensors, (encoder, unit, first, last) = gru_file
    observation = np.random.default_rng(4).normal(0, 2, size=(3, 12, 2, 5)).astype(np.float32)
    actions = played(load_network(path), observation)
    with torch.no_grad():
        # torch takes each agent of each world as a sequence of its own
        seen = whitened(tensors, observation).permute(0, 2, 1, 3).reshape(6, 12, 5)
        remembered, _ = unit(torch.relu(encoder(seen)))
        expected = torch.tanh(last(torch.relu(first(remembered)))).reshape(3, 2, 12, 4).permute(0, 2, 1, 3)
    assert actions.std() > 0.1
    np.testing.assert_allclose(actions, expected.numpy(), atol=1e-4)  # 12 steps rounded to 1.5e-5 each


def test_a_gru_remembers_for_each_agent_alone(gru_file):
    policy = load_network(gru_file[0])
    observation = np.random.default_rng(4).normal(0, 2, size=(1, 6, 2, 5)).astype(np.float32)
    changed = observation.copy()
    changed[:, 0, 0] += 1.0
    one, other = played(policy, observation), played(policy, changed)
    np.testing.assert_array_equal(one[:, :, 1], other[:, :, 1])
    assert (one[:, 1:, 0] != other[:, 1:, 0]).any()


LAYOUT = make("hazard_nav-4").layout.observation


EACH = {"seen": 1, "health": 1, "position": 3, "velocity": 3}
"""Numbers per neighbour."""


@pytest.fixture(scope="module", params=["attention", "mean"])
def attention_file(request, tmp_path_factory):
    """A file, its tensors and torch's own modules: one asks with four heads, the other takes the mean."""
    torch.manual_seed(2)
    # own: health 1, velocity 3, position 3; a neighbour: 8; a point: position 3, hazardous 1, gap 1
    sizes = {"own": (7, 16), "neighbor": (8, 16), "point": (5, 16), "layer0": (32, 3)}
    parts = {name: nn.Linear(*size) for name, size in sizes.items()}
    spec = AttentionSpec.of(LAYOUT, "neighbor", "point", pool="mean")
    if request.param == "attention":
        spec = AttentionSpec.of(LAYOUT, "neighbor", "point", heads=4)
        parts["attention"] = nn.MultiheadAttention(16, 4, batch_first=True)
        nn.init.normal_(parts["attention"].in_proj_bias)
        nn.init.normal_(parts["attention"].out_proj.bias)
    tensors = {"observation.mean": np.full(LAYOUT.size, 0.1), "observation.scale": np.full(LAYOUT.size, 1.5)}
    for name, part in parts.items():
        tensors |= plain(part, f"{name}.")
    path = tmp_path_factory.mktemp("attention") / "one.safetensors"
    save_network(tensors, path, spec)
    return path, tensors, parts


def observations(batch, team):
    """Observations of `LAYOUT` in which 0 to 3 neighbours are seen; there is something in empty slots too."""
    chance = np.random.default_rng(5)
    flat = chance.normal(0, 1, size=(batch, team, LAYOUT.size)).astype(np.float32)
    flat[..., LAYOUT.slices["neighbor_seen"]] = np.arange(3) < chance.integers(0, 4, (batch, team, 1))
    return flat


def by_torch(tensors, parts, observation):
    """One world's actions; agents one by one, tokens one by one."""
    actions = []
    for raw, white in zip(observation, whitened(tensors, observation).numpy(), strict=True):
        blocks = {block.name: torch.tensor(LAYOUT.view(white, block.name)) for block in LAYOUT.blocks}
        own = torch.tanh(
            parts["own"](torch.cat([blocks[name] for name in ("health", "velocity", "position")]))
        )
        tokens = []
        for k in np.flatnonzero(LAYOUT.view(raw, "neighbor_seen") > 0).tolist():
            fields = [blocks[f"neighbor_{name}"][k].reshape(size) for name, size in EACH.items()]
            tokens.append(torch.tanh(parts["neighbor"](torch.cat(fields))))
        for k in range(4):
            fields = [blocks[f"point_{name}"][k].reshape(-1) for name in ("position", "hazardous", "gap")]
            tokens.append(torch.tanh(parts["point"](torch.cat(fields))))
        stack = torch.stack(tokens)
        if "attention" in parts:
            answer = parts["attention"](own[None, None], stack[None], stack[None], need_weights=False)[0][
                0, 0
            ]
        else:
            answer = stack.mean(0)
        actions.append(parts["layer0"](torch.cat([own, answer])).clamp(-1, 1))
    return torch.stack(actions).numpy()


def test_attention_is_torchs(attention_file):
    path, tensors, parts = attention_file
    observation = observations(6, 4)
    action, _ = load_network(path).act(observation, None, np.ones((6, 4), bool))
    with torch.no_grad():
        expected = np.stack([by_torch(tensors, parts, world) for world in observation])
    assert expected.std() > 0.1
    np.testing.assert_allclose(action, expected, atol=1e-4)


def test_neighbours_are_looked_at_alike(attention_file):
    """Their order makes no difference, nor what stands in the slots that hold nobody."""
    policy, observation, alive = load_network(attention_file[0]), observations(5, 4), np.ones((5, 4), bool)
    turned = observation.copy()
    for name in EACH:
        block = LAYOUT.view(observation, f"neighbor_{name}")
        turned[..., LAYOUT.slices[f"neighbor_{name}"]] = block[:, :, ::-1].reshape(5, 4, -1)
    action = policy.act(observation, None, alive)[0]
    np.testing.assert_array_equal(policy.act(turned, None, alive)[0], action)
    empty = LAYOUT.view(observation, "neighbor_seen") == 0
    filled = observation.copy()
    filled[..., LAYOUT.slices["neighbor_health"]] += empty
    np.testing.assert_array_equal(policy.act(filled, None, alive)[0], action)
    filled[..., LAYOUT.slices["neighbor_health"]] += ~empty
    assert (policy.act(filled, None, alive)[0] != action).any()


def test_who_sees_nobody_gets_zeros_for_an_answer(tmp_path):
    """With neighbours as the only group and a last layer that passes the answer on, that is the action."""
    spec = AttentionSpec.of(LAYOUT, "neighbor", heads=1)
    torch.manual_seed(0)
    attention = nn.MultiheadAttention(3, 1, batch_first=True)
    nn.init.ones_(attention.out_proj.bias)
    tensors = {"observation.mean": np.zeros(LAYOUT.size), "observation.scale": np.ones(LAYOUT.size)}
    tensors |= plain(nn.Linear(LAYOUT.size - 24, 3), "own.") | plain(nn.Linear(8, 3), "neighbor.")
    tensors |= plain(attention, "attention.")
    tensors |= {"layer0.weight": np.hstack([np.zeros((3, 3)), np.eye(3)]), "layer0.bias": np.zeros(3)}
    save_network(tensors, tmp_path / "one.safetensors", spec)
    observation = observations(8, 4)
    nobody = ~LAYOUT.view(observation, "neighbor_seen").any(-1)
    action, _ = load_network(tmp_path / "one.safetensors").act(observation, None, np.ones((8, 4), bool))
    assert 0 < nobody.sum() < nobody.size
    assert (action[nobody] == 0).all()
    assert (action[~nobody] != 0).all()


def test_actions_do_not_depend_on_the_batch(gru_file, attention_file):
    for path in (gru_file[0], attention_file[0]):
        policy = load_network(path)
        shape = (64, 10, 4, policy.observation_size)
        observation = np.random.default_rng(9).normal(0, 1, size=shape).astype(np.float32)
        together = played(policy, observation)
        for b in range(0, 64, 7):
            np.testing.assert_array_equal(played(policy, observation[b : b + 1])[0], together[b])


def test_attention_is_for_one_observation_only(attention_file, tmp_path):
    """Two tasks may show as many numbers that mean something else."""
    (tmp_path / "agent.toml").write_text('name = "one"\nsummary = "s"\nkind = "network"')
    (tmp_path / "hazard_nav-4").mkdir()
    path = tmp_path / "hazard_nav-4" / "seed0.safetensors"
    shutil.copy(attention_file[0], path)
    spec = task_spec("hazard_nav-4")
    assert load_agent(tmp_path).policy(spec).observation_size == LAYOUT.size
    network_spec = load_network(path).spec
    renamed = tuple(
        ("point_hazard" if name == "point_hazardous" else name, shape)
        for name, shape in network_spec.observation
    )
    blocks = tuple(
        "point_hazard" if name == "point_hazardous" else name for name in network_spec.groups["point"].blocks
    )
    groups = network_spec.groups | {"point": Group(blocks=blocks)}
    save_network(
        attention_file[1], path, network_spec.model_copy(update={"observation": renamed, "groups": groups})
    )
    with pytest.raises(
        BundleError, match=r"shows the blocks health \(1,\), .*its network declares .*point_hazard \(4,\)"
    ):
        load_agent(tmp_path).policy(spec)


def test_a_form_says_which_blocks_there_are():
    with pytest.raises(
        BundleError, match=r"no blocks 'neighbour_...' in the observation; did you mean 'neighbor'"
    ):
        AttentionSpec.of(LAYOUT, "neighbour")


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"gru.weight_hh": (18, 5)}, "gru.weight_ih is (18, 8); expected (15, 8)"),
        ({"gru.weight_hh": (18,)}, "gru.weight_hh is (18,); expected (3 H, H)"),
        ({"gru.weight_hh": (0,)}, "gru.weight_hh is (0,); expected (3 H, H)"),
        ({"gru.weight_ih": (18, 5)}, "gru.weight_ih is (18, 5); expected (18, 8)"),
        ({"gru.bias_ih": (6,)}, "gru.bias_ih is (6,); expected (18,)"),
        ({"layer0.weight": (7, 8)}, "layer0 is (7, 8), (7,); expected (out, 6), (out,)"),
        ({"layer0.weight": None}, "layer0, from the memory to the action, is missing"),
        ({"gru.bias_hh": None}, "gru.bias_hh is None; expected (18,)"),
        ({"weight": (3,)}, "tensors ["),
        ({"observation.mean": (5, 1)}, "observation.mean and .scale must be (O,)"),
    ],
)
def test_malformed_gru_files_are_refused(gru_file, tmp_path, changed, reason):
    shapes = {name: tensor.shape for name, tensor in gru_file[1].items()} | changed
    content = {name: np.ones(shape, np.float32) for name, shape in shapes.items() if shape is not None}
    save_network(content, tmp_path / "one.safetensors", GRUSpec())
    with pytest.raises(BundleError) as caught:
        load_network(tmp_path / "one.safetensors")
    assert reason in str(caught.value)


OBSERVED = AttentionSpec.of(LAYOUT, "neighbor").observation
BLOCKS = ("neighbor_seen", "neighbor_health")


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"groups": {}}, "groups = {} is refused"),
        ({"groups": {"own": {"blocks": BLOCKS}}}, "group 'own'"),
        (
            {"groups": {"n": {"blocks": ("neighbor_sen",)}}},
            "group 'n': its blocks are not in the observation",
        ),
        ({"groups": {"n": {"blocks": BLOCKS}, "m": {"blocks": BLOCKS}}}, "group 'm': its blocks are not in"),
        ({"groups": {"n": {"blocks": ("point_gap", "neighbor_seen")}}}, "different numbers of slots"),
        (
            {"groups": {"n": {"blocks": BLOCKS, "present": "point_gap"}}},
            "'present' must be a block of its own",
        ),
        (
            {"observation": (*OBSERVED, ("more", (4096, 4096, 4096)))},
            "hold 51 numbers as observation.mean, got 687",
        ),
        ({"observation": (*OBSERVED[:-1], OBSERVED[0])}, "different names"),
        ({"observation": (*OBSERVED[:-1], ("x", (-3,)))}, "is refused"),
        ({"heads": 5}, "own.bias is (16,); expected a positive multiple of 5 heads"),
        ({"pool": "max"}, "pool = 'max' is refused"),
        ({"pool": "mean"}, "tensors ["),
    ],
)
def test_malformed_attention_files_are_refused(tmp_path, changed, reason):
    spec = json.loads(AttentionSpec.of(LAYOUT, "neighbor").model_dump_json()) | changed
    parts = {
        "own": nn.Linear(27, 16),
        "neighbor": nn.Linear(8, 16),
        "attention": nn.MultiheadAttention(16, 4),
    }
    content = normaliser(LAYOUT.size) | plain(nn.Linear(32, 3), "layer0.")
    for name, part in parts.items():
        content |= plain(part, f"{name}.")
    plain32 = {name: np.ascontiguousarray(tensor, np.float32) for name, tensor in content.items()}
    save_file(plain32, tmp_path / "one.safetensors", {"format": f"hipg-attention-1 {json.dumps(spec)}"})
    with pytest.raises(BundleError) as caught:
        load_network(tmp_path / "one.safetensors")
    assert reason in str(caught.value)


def header(path, tensors, size=0):
    """A file that declares tensors it may not hold."""
    text = json.dumps({"__metadata__": {"format": "hipg-mlp-2 {}"}} | tensors).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(size))
    return path


def entry(shape, start, end, dtype="F32"):
    return {"dtype": dtype, "shape": shape, "data_offsets": [start, end]}


def hostile_files(folder):
    """Name of the trick to a file that plays it, and why it is refused."""
    good = {name: np.ascontiguousarray(array, np.float32) for name, array in tensors().items()}
    made = {"double": {name: array.astype(np.float64) for name, array in good.items()}}
    for name, value in (("nan", np.nan), ("infinite", np.inf), ("huge", 1e9)):
        made[name] = good | {"layer0.bias": np.full(6, value, np.float32)}
    made["scale"] = good | {"observation.scale": np.zeros(5, np.float32)}
    made["wide"] = {"observation.mean": np.zeros(5, np.float32), "observation.scale": np.ones(5, np.float32)}
    made["wide"] |= {
        "layer0.weight": np.zeros((5000, 5), np.float32),
        "layer0.bias": np.zeros(5000, np.float32),
    }
    for name, content in made.items():
        save_file(content, folder / name, {"format": "hipg-mlp-2 {}"})
    header(folder / "lying", {"layer0.weight": entry([2**40, 2**20], 0, 2**62)})
    header(folder / "short", {"layer0.weight": entry([4, 4], 0, 16)}, 16)
    (folder / "header").write_bytes((2**40).to_bytes(8, "little") + b"{}")
    (folder / "garbage").write_bytes(b"\x80\x04cposix\nsystem\n.")
    (folder / "empty").write_bytes(b"")
    with (folder / "bulky").open("wb") as file:
        file.truncate(2**31)  # sparse: takes no room on the disk
    return {
        "double": "must be finite float32, got F64",
        "nan": "layer0.bias must be finite and within +-1e+06: 6 are not finite",
        "infinite": "6 are not finite",
        "huge": "the largest is 1e+09",
        "scale": "observation.scale must be > 0",
        "wide": "layer0 is (5000, 5), (5000,); expected (out, 5), (out,) with out <= 4096",
        "lying": "", "short": "", "header": "", "garbage": "", "empty": "",
        "bulky": "at most 81000000 bytes are allowed, got 2147483648",
    }  # fmt: skip


@pytest.fixture(scope="module")
def sound_files(gru_file, attention_file):
    return [gru_file[0], attention_file[0]]


@given(data=st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_file_is_refused_or_a_sound_network(sound_files, tmp_path, data):
    """Bytes changed, cut or put in anywhere, most of them in the header."""
    content = bytearray(data.draw(st.sampled_from(sound_files)).read_bytes())
    header = int.from_bytes(content[:8], "little")
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, min(header + 20, len(content) - 1)))
        match data.draw(st.sampled_from(["set", "cut", "put"])):
            case "set":
                content[at] = data.draw(st.sampled_from(b'0123456789[]{},:" FNI\xff\x00'))
            case "cut":
                del content[at : at + data.draw(st.integers(1, 8))]
            case "put":
                content[at:at] = data.draw(
                    st.sampled_from([b"9", b"null", b"[", b"NaN", b'"x":', b"1e999", b"-"])
                )
    (tmp_path / "one").write_bytes(content)
    try:
        policy = load_network(tmp_path / "one")
    except BundleError:
        return
    seen = np.full((2, 3, policy.observation_size), 1e30, np.float32)
    action, _ = policy.act(seen, policy.initial_state(0, np.arange(2), 3), np.ones((2, 3), bool))
    assert np.isfinite(action).all()


def test_hostile_files_are_refused(tmp_path):
    for name, reason in hostile_files(tmp_path).items():
        with pytest.raises(BundleError, match=re.escape(name)) as caught:
            load_network(tmp_path / name)
        assert reason in str(caught.value)
