"""Writes upcr_network*.safetensors: small networks with random weights, and what bench/plain_network.py makes of two
pairs of clouds. Each file is a weights file of ours with further tensors in it (README.md)."""

import sys
from contextlib import contextmanager
from pathlib import Path

import torch
from safetensors.torch import save_file

sys.path.append(str(Path(__file__).resolve().parents[4] / "bench"))
import plain_network as plain

SIZES = [64, 72, 80, 56]  # two sources, two targets


def random_clouds() -> list[torch.Tensor]:
    """Samples of a bumpy ellipsoid; each target is another sample of its source's surface, moved."""
    clouds = []
    for pair in range(2):
        angles = torch.rand(1, 3) * 0.8
        motion = plain.rotation_matrix(angles, "euler")[0], torch.rand(3) - 0.5
        for size, (r, t) in zip(SIZES[pair::2], [(torch.eye(3), torch.zeros(3)), motion]):
            direction = torch.nn.functional.normalize(torch.randn(size, 3), dim=1)
            bumps = 1 + 0.2 * torch.sin(3 * direction[:, :1] + pair) * torch.cos(2 * direction[:, 1:2])
            clouds.append((direction * bumps * torch.tensor([1.0, 0.7, 0.5])) @ r.T + t)
    # Sources first, then targets; what is stored in single precision is what is computed with.
    return [clouds[i].float().double() for i in [0, 2, 1, 3]]


def randomize(network: plain.Network, points: torch.Tensor) -> None:
    """Weights of all signs, scales of batch norm among them; running statistics near those of the clouds."""
    with torch.no_grad():
        for name, p in network.named_parameters():
            if name.endswith("gamma"):
                p.copy_((0.5 + torch.rand_like(p)) * torch.where(torch.rand_like(p) < 0.3, -1.0, 1.0))
            elif name.endswith(("beta", "bias")):
                p.copy_(torch.randn_like(p) * 0.2)
            # Poses of moderate size.
            elif name == f"head.{len(network.head) - 1}.weight":
                p *= 0.1
            p.copy_(p.float())
        network.eval()
        with visited(network, disturb):
            network(points, SIZES)


def disturb(_: str, layer: plain.EdgeLayer, mean: torch.Tensor, var: torch.Tensor) -> None:
    layer.mean.copy_((mean + 0.1 * torch.randn_like(mean)).float())
    layer.var.copy_((var * (0.7 + 0.6 * torch.rand_like(var))).float())


@contextmanager
def visited(network: plain.Network, visit):
    """Calls `visit` with every edge layer's name, itself, and its values' mean and biased variance before it runs."""

    def before(name):
        def hook(layer, inputs):
            values = (inputs[0] @ layer.weight).flatten(0, 1).detach()
            visit(name, layer, values.mean(dim=0), values.var(dim=0, correction=0))

        return hook

    layers = [(n, m) for n, m in network.named_modules() if isinstance(m, plain.EdgeLayer)]
    hooks = [layer.register_forward_pre_hook(before(name)) for name, layer in layers]
    yield
    for hook in hooks:
        hook.remove()


def golden(config: plain.Config) -> dict[str, torch.Tensor]:
    clouds = random_clouds()
    points = torch.cat(clouds)
    network = plain.Network(config)
    randomize(network, points)
    tensors = {name: value.clone() for name, value in network.state_dict().items()}
    roles = ["source.0", "source.1", "target.0", "target.1"]

    graphs: list[torch.Tensor] = []
    found = plain.nearest

    def recorded(*args):
        graphs.append(found(*args))
        return graphs[-1]

    plain.nearest = recorded
    network.eval()
    with torch.no_grad():
        centroids, *gammas = network.representations(points, SIZES)
        head = network.pose_values(gammas[-1])
        r, t = network(points, SIZES)
        r, t = plain.relative_pose(r, t)
    plain.nearest = found

    starts = torch.tensor([0, *SIZES]).cumsum(0)
    for c, role in enumerate(roles):
        tensors[f"input.{role}"] = clouds[c]
        rows = slice(starts[c], starts[c + 1])
        tensors[f"graph.{role}"] = (graphs[0][rows] - starts[c]).int()
        for name, gamma in zip(["global", "invariant", "pose"], gammas):
            tensors[f"eval.{role}.{name}"] = gamma[c]
        tensors[f"eval.{role}.head"] = head[c]
        if config.graph == "dynamic":
            layers = len(config.widths)
            branches = ["global", "invariant"][: 1 if config.invariant == "none" else 2]
            for b, branch in enumerate(branches):
                for l in range(layers):
                    graph = graphs[1 + b * layers + l][rows] - starts[c]
                    tensors[f"graph.{role}.{branch}.{l}"] = graph.int()
    tensors["eval.rotation"], tensors["eval.translation"] = r, t

    if config.graph == "static":
        network.train()

        def note(name, _, mean, var):
            tensors[f"train.{name}.mean"], tensors[f"train.{name}.var"] = mean, var

        with visited(network, note):
            centroids, *gammas = network.representations(points, SIZES)
        values = network.pose_values(gammas[-1])
        tensors["train.head"] = values.detach()
        rotations = plain.rotation_matrix(values[:, :-3], config.rotation)
        loss = plain.chamfer_loss(points, SIZES, rotations, centroids + values[:, -3:])
        loss.backward()
        tensors["train.loss"] = loss.detach()[None]
        for name, p in network.named_parameters():
            tensors[f"train.grad.{name}"] = p.grad
    return tensors


def rotations() -> dict[str, torch.Tensor]:
    """Each kind's values, their rotations, and the gradient of Σ R·C for a fixed C."""
    tensors = {"rotation.C": torch.randn(3, 3).float().double()}
    for kind, values in plain.ROTATION_VALUES.items():
        inputs = (torch.randn(6, values) * 0.6).float().double().requires_grad_()
        r = plain.rotation_matrix(inputs, kind)
        (r * tensors["rotation.C"]).sum().backward()
        tensors |= {
            f"rotation.{kind}.values": inputs.detach(),
            f"rotation.{kind}.R": r.detach(),
            f"rotation.{kind}.grad": inputs.grad,
        }
    return tensors


def write(name: str, config: plain.Config, tensors: dict[str, torch.Tensor]) -> None:
    stored = {n: (v.float() if v.is_floating_point() else v).contiguous() for n, v in tensors.items()}
    save_file(stored, name, metadata={"upcr.config": config.json(), "upcr.trained": "false"})
    print(name, Path(name).stat().st_size, "bytes")


torch.manual_seed(11)
torch.set_default_dtype(torch.float64)
small = dict(k=6, widths=[8, 8, 16, 16, 32], head=[16, 8])
config = plain.Config(**small)
write("upcr_network.safetensors", config, golden(config) | rotations())
tiny = dict(k=5, widths=[8, 12, 16], head=[8])
config = plain.Config(**tiny, graph="dynamic", rotation="six_d")
write("upcr_network_dynamic.safetensors", config, golden(config))
config = plain.Config(**tiny, invariant="none", rotation="quaternion", negative_slope=0.1)
write("upcr_network_none.safetensors", config, golden(config))
