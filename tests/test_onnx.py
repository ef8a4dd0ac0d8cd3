"""ONNX agents act as the graph does, one agent at a time in a sandbox; those that can do more are refused."""

import contextlib
import resource
import warnings

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import nn

from hipg_bench import make, task_spec
from hipg_bench.errors import AgentFailure, BundleError
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.graph import check_graph
from hipg_bench.sandbox.inside.graph_checker import GraphError, read_graph

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

SPEC = task_spec("hazard_nav-4")
SIZE = make(SPEC).layout.observation.size


class Remembering(nn.Module):
    """A gated recurrent unit, as somebody would train it."""

    def __init__(self):
        super().__init__()
        self.unit, self.out = nn.GRUCell(SIZE, 16), nn.Linear(16, 3)

    def forward(self, observation, memory):
        memory = self.unit(observation, memory)
        return torch.tanh(self.out(memory)), memory


def bundle(folder, content, seed=0):
    (folder / SPEC.task).mkdir(parents=True, exist_ok=True)
    (folder / "agent.toml").write_text('name = "graph"\nsummary = "s"\nkind = "onnx"')
    path = folder / SPEC.task / f"seed{seed}.onnx"
    path.write_bytes(content if isinstance(content, bytes) else content.SerializeToString())
    return load_agent(folder)


@pytest.fixture(scope="module")
def recurrent(tmp_path_factory):
    torch.manual_seed(3)
    module, folder = Remembering(), tmp_path_factory.mktemp("recurrent")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the older exporter needs no further package
        torch.onnx.export(
            module, (torch.zeros(1, SIZE), torch.zeros(1, 16)), folder / "graph.onnx", dynamo=False,
            input_names=["observation", "memory_in"], output_names=["action", "memory_out"],
        )  # fmt: skip
    return bundle(folder, (folder / "graph.onnx").read_bytes()), module


def played(policy, observation, alive):
    """(B, T, N, A)."""
    memory, done = policy.initial_state(0, np.arange(len(observation)), observation.shape[2]), []
    for seen in observation.swapaxes(0, 1):
        action, memory = policy.act(seen, memory, alive)
        done.append(action)
    return np.stack(done, axis=1)


def test_a_graph_is_torchs_for_each_agent_alone_whatever_the_batch(recurrent):
    agent, module = recurrent
    assert agent.card.tier == 1
    assert agent.train_seeds(SPEC.task) == (0,)
    observation = np.random.default_rng(1).normal(0, 1, (3, 7, 4, SIZE)).astype(np.float32)
    alive = np.ones((3, 4), bool)
    alive[1, 2] = False
    actions = played(agent.policy(SPEC), observation, alive)
    with torch.no_grad():
        memory = torch.zeros(12, 16)
        for t in range(7):
            expected, memory = module(torch.tensor(observation[:, t].reshape(12, SIZE)), memory)
            expected = np.where(alive[..., None], expected.numpy().reshape(3, 4, 3), 0)
            np.testing.assert_allclose(actions[:, t], expected, atol=3e-5)
    alone = played(agent.policy(SPEC), observation[2:], alive[2:])
    np.testing.assert_array_equal(alone[0], actions[2])


def linear(nodes=(), out="action", **changed):
    """A model: action = observation @ weight, or what ``nodes`` make of it; and some fields changed."""
    weight = helper.make_tensor("weight", TensorProto.FLOAT, [SIZE, 3], np.full(SIZE * 3, 0.01).tolist())
    fields = {
        "inputs": [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", SIZE])],
        "outputs": [helper.make_tensor_value_info(out, TensorProto.FLOAT, ["batch", 3])],
        "nodes": list(nodes) or [helper.make_node("MatMul", ["observation", "weight"], [out])],
        "initializer": [weight],
        "opsets": [helper.make_opsetid("", 17)],
    } | changed
    graph = helper.make_graph(
        fields["nodes"], "g", fields["inputs"], fields["outputs"], fields["initializer"]
    )  # fmt: skip
    return helper.make_model(graph, opset_imports=fields["opsets"], ir_version=9)


def test_a_graph_cannot_let_agents_know_of_each_other(tmp_path):
    """This one subtracts the batch's mean: shown several agents at once, it would tell each of the others."""
    nodes = [
        helper.make_node("ReduceMean", ["observation"], ["mean"], axes=[0], keepdims=1),
        helper.make_node("Sub", ["observation", "mean"], ["less"]),
        helper.make_node("MatMul", ["less", "weight"], ["action"]),
    ]
    agent = bundle(tmp_path, linear(nodes))
    observation = np.random.default_rng(1).normal(0, 1, (2, 1, 4, SIZE)).astype(np.float32)
    # alone, each is its own mean
    assert (played(agent.policy(SPEC), observation, np.ones((2, 4), bool)) == 0).all()


def test_what_the_runtime_refuses_is_a_crash_of_the_agent(tmp_path):
    """The sizes of a matrix product do not fit: nothing that a look at the file would show."""
    weight = helper.make_tensor("weight", TensorProto.FLOAT, [SIZE + 1, 3], np.ones(SIZE * 3 + 3).tolist())
    agent = bundle(tmp_path, linear(initializer=[weight]))
    with pytest.raises(AgentFailure, match=r"InferenceError|Incompatible dimensions") as caught:
        agent.policy(SPEC).initial_state(0, np.arange(1), 4)
    assert caught.value.status == "crash"


def outside():
    """Weights in another file, as a path out of the folder."""
    tensor = TensorProto(name="weight", data_type=TensorProto.FLOAT, dims=[SIZE, 3], data_location=1)
    tensor.external_data.add(key="location", value="../../etc/passwd")
    return tensor


def branch():
    """The same, hidden in a branch of a node."""
    inner = helper.make_graph([], "inner", [], [], [outside()])
    return helper.make_node("If", ["observation"], ["action"], then_branch=inner, else_branch=inner)


def info(name, shape, kind=TensorProto.FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


SEEN, MADE = info("observation", ["batch", SIZE]), info("action", ["batch", 3])
MEMORY, AFTER = info("memory_in", [1, 8]), info("memory_out", [1, 8])


def function():
    made = linear()
    made.functions.append(helper.make_function("", "f", [], [], [], [helper.make_opsetid("", 17)]))
    return made


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (lambda: linear(initializer=[outside()]), "weights 'weight' lie in another file: export with"),
        (lambda: linear([branch()]), "weights 'weight' lie in another file"),
        (
            lambda: linear([helper.make_node("Constant", [], ["action"], value=outside())]),
            "weights 'weight' lie in another file",
        ),
        (lambda: linear([helper.make_node("Go", [], ["action"], domain="evil")]), "domain 'evil'"),
        (lambda: linear(opsets=[helper.make_opsetid("", 17), helper.make_opsetid("com.x", 1)]), "'com.x'"),
        (lambda: linear(opsets=[helper.make_opsetid("", 7)]), "opset 13 to 23 is allowed, got 7"),
        (lambda: linear(opsets=[]), "it must name one opset"),
        (lambda: linear([helper.make_node("RandomNormal", [], ["action"], shape=[1, 3])]), "drawn at random"),
        (function, "functions and training steps of its own"),
        (lambda: linear(out="actoin"), "no input or output 'actoin' is allowed; did you mean 'action'?"),
        (lambda: linear(inputs=[]), "'observation' is missing"),
        (lambda: linear(inputs=[info("observation", [1, SIZE + 1])]), f"observation must be (1, {SIZE}) or"),
        (lambda: linear(inputs=[info("observation", [4, SIZE])]), f"observation must be (1, {SIZE}) or"),
        (lambda: linear(outputs=[info("action", [3])]), "action must be (1, 3) or (batch, 3), got (3,)"),
        (lambda: linear(outputs=[info("action", [1, 3], TensorProto.DOUBLE)]), "must be a float32 tensor"),
        (lambda: linear(inputs=[SEEN, MEMORY]), "'memory_in' and 'memory_out' are only allowed together"),
        (
            lambda: linear(inputs=[SEEN, info("memory_in", [1, "h"])], outputs=[MADE, AFTER]),
            "memory_in must be (1, H) or (batch, H) with a number H, got (1, -1)",
        ),
        (lambda: b"\x80\x04cposix\nsystem\n.", "not an ONNX file"),
        (lambda: b"", "it must name one opset"),
    ],
)  # fmt: skip
def test_graphs_that_could_do_more_are_refused(tmp_path, model, reason):
    agent = bundle(tmp_path, model())
    with pytest.raises(BundleError) as caught:
        agent.policy(SPEC)
    assert reason in str(caught.value)


def test_a_graph_with_sparse_weights_is_refused(tmp_path):
    model = linear()
    model.graph.sparse_initializer.add()
    with pytest.raises(BundleError, match="sparse weights are not allowed"):
        bundle(tmp_path, model).policy(SPEC)


@given(data=st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_graph_is_refused_or_looks_sound(recurrent, tmp_path, data):
    """Of bytes changed anywhere come reasons only; what looks sound meets the checker in the sandbox."""
    content = bytearray((recurrent[0].folder / SPEC.task / "seed0.onnx").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "one.onnx").write_bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))])
    setup = {"folder": tmp_path, "options": {"file": "one.onnx"}}
    with contextlib.suppress(GraphError):
        read_graph(setup | {"task": {"observation_size": SIZE, "action_size": 3}})


def test_a_large_file_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "large.onnx").open("wb") as file:
        file.truncate(10**9)
    with pytest.raises(BundleError, match="at most 64000000 bytes are allowed, got 1000000000"):
        check_graph(tmp_path / "large.onnx", SPEC)


def test_a_layer_that_drops_out_while_it_plays_is_refused(tmp_path):
    """Dropout in training mode is chance; in evaluation mode, without the third input, it is not."""
    ratio, training = (
        numpy_helper.from_array(np.asarray(value), name)
        for name, value in (("ratio", np.float32(0.5)), ("training", np.bool_(True)))
    )
    nodes = [
        helper.make_node("MatMul", ["observation", "weight"], ["x"]),
        helper.make_node("Dropout", ["x", "ratio", "training"], ["action"]),
    ]
    model = linear(nodes)
    model.graph.initializer.extend([ratio, training])
    with pytest.raises(BundleError, match="'Dropout' is not allowed: actions must not be drawn at random"):
        bundle(tmp_path, model).policy(SPEC)


def test_reading_a_graph_takes_no_memory_here(tmp_path):
    """Eight million empty bytes of nodes become some 600 MB of objects: in the child."""
    body = b"\x0a\x00" * 4_000_000
    length, size = b"", len(body)
    while size:
        length += bytes([size & 127 | (128 if size > 127 else 0)])
        size >>= 7
    (tmp_path / "bomb.onnx").write_bytes(b"\x3a" + length + body + b"\x42\x04\x0a\x00\x10\x11")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BundleError):
        check_graph(tmp_path / "bomb.onnx", SPEC)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB
