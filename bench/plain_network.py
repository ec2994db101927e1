"""The UPCR network written plainly in PyTorch, with its edge tensors: the yardstick of ours in speed and in numbers.

Parameters have the names and layouts of a weights file of ours, so `state_dict` is one. Clouds of a batch may differ in
size: they are one after the other in one tensor of points, (N, 3), `sizes` long each.
"""

import json
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional

EPS = 1e-5
ROTATION_VALUES = {"euler": 3, "quaternion": 4, "six_d": 6, "matrix": 9}


@dataclass
class Config:
    k: int = 24
    widths: list[int] = field(default_factory=lambda: [64, 64, 128, 256, 512])
    graph: str = "static"
    negative_slope: float = 0.2
    invariant: str = "distance"
    rotation: str = "euler"
    head: list[int] = field(default_factory=lambda: [256, 128])

    def json(self) -> str:
        return json.dumps(asdict(self))


class EdgeLayer(nn.Module):
    """Linear map without bias over edges, batch norm over all of them, leaky rectifier, max over the neighbours."""

    def __init__(self, inputs: int, outputs: int, slope: float):
        super().__init__()
        self.slope = slope
        self.weight = nn.Parameter(torch.randn(inputs, outputs) * (2 / inputs) ** 0.5)
        self.gamma = nn.Parameter(torch.ones(outputs))
        self.beta = nn.Parameter(torch.zeros(outputs))
        self.register_buffer("mean", torch.zeros(outputs))
        self.register_buffer("var", torch.ones(outputs))

    def forward(self, edges: Tensor) -> Tensor:  # (N, K, inputs) -> (N, outputs)
        values = edges @ self.weight
        flat = values.flatten(0, 1)
        # Normalised by the biased variance in training, as everywhere.
        flat = functional.batch_norm(flat, self.mean, self.var, self.gamma, self.beta, self.training, 0.1, EPS)
        return functional.leaky_relu(flat.view_as(values), self.slope).max(dim=1).values


class Network(nn.Module):
    def __init__(self, config: Config):
        super().__init__()
        self.config = config
        widths, slope = config.widths, config.negative_slope

        def graph_layers(inputs: int) -> list[nn.Module]:
            return [EdgeLayer(2 * a, b, slope) for a, b in zip([inputs, *widths[:-1]], widths)]

        self.add_module("global", nn.ModuleList(graph_layers(3)))
        if config.invariant != "none":
            layers = {str(i): layer for i, layer in enumerate(graph_layers(widths[0]))}
            self.invariant = nn.ModuleDict({"embed": EdgeLayer(3, widths[0], slope), **layers})
        outputs = ROTATION_VALUES[config.rotation] + 3
        sizes = [widths[-1], *config.head, outputs]
        self.head = nn.ModuleList(Linear(a, b) for a, b in zip(sizes, sizes[1:]))

    def representations(self, points: Tensor, sizes: list[int], graph: Tensor | None = None) -> tuple[Tensor, ...]:
        """Centroids (C, 3) and the representations (C, m): global, invariant, pose-related."""
        centroids = torch.stack([cloud.mean(dim=0) for cloud in points.split(sizes)])
        repeats = torch.tensor(sizes, device=points.device)
        x = points - centroids.repeat_interleave(repeats, dim=0)
        if graph is None:
            graph = nearest(x, sizes, self.config.k)
        gamma_g = self.branch(list(getattr(self, "global")), x, sizes, graph)
        if self.config.invariant == "none":
            return centroids, gamma_g, gamma_g, gamma_g
        layers = [self.invariant[str(i)] for i in range(len(self.config.widths))]
        embedded = self.invariant["embed"](distances(x, graph))
        gamma_v = self.branch(layers, embedded, sizes, graph)
        log_q, log_p = functional.log_softmax(gamma_g, dim=1), functional.log_softmax(gamma_v, dim=1)
        gamma_mu = gamma_g.shape[1] * log_p.exp() * (log_p - log_q)
        return centroids, gamma_g, gamma_v, gamma_mu

    def branch(self, layers: list[nn.Module], features: Tensor, sizes: list[int], graph: Tensor) -> Tensor:
        for layer in layers:
            if self.config.graph == "dynamic":
                graph = nearest(features, sizes, self.config.k)
            features = layer(edge_tensor(features, graph))
        return torch.stack([cloud.max(dim=0).values for cloud in features.split(sizes)])

    def pose_values(self, gamma_mu: Tensor) -> Tensor:
        values = gamma_mu
        for i, linear in enumerate(self.head):
            values = linear(values)
            if i + 1 < len(self.head):
                values = functional.leaky_relu(values, self.config.negative_slope)
        return values

    def forward(self, points: Tensor, sizes: list[int], graph: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Each cloud's pose about the latent canonical shape: (C, 3, 3), (C, 3)."""
        centroids, _, _, gamma_mu = self.representations(points, sizes, graph)
        values = self.pose_values(gamma_mu)
        return rotation_matrix(values[:, :-3], self.config.rotation), centroids + values[:, -3:]


class Linear(nn.Module):
    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(inputs, outputs) * (2 / inputs) ** 0.5)
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        return x @ self.weight + self.bias


def nearest(features: Tensor, sizes: list[int], k: int) -> Tensor:
    """Indices (N, K) of the nearest points of the same cloud, each point itself among them."""
    rows, start = [], 0
    for cloud in features.detach().split(sizes):
        squares = (cloud * cloud).sum(dim=1)
        distances_sq = squares[:, None] + squares[None, :] - 2 * cloud @ cloud.T
        rows.append(distances_sq.topk(min(k, len(cloud)), dim=1, largest=False).indices + start)
        start += len(cloud)
    return torch.cat(rows)


def edge_tensor(features: Tensor, graph: Tensor) -> Tensor:
    """[F_i ; F_j - F_i] of every edge, (N, K, 2c)."""
    center = features[:, None, :].expand(-1, graph.shape[1], -1)
    return torch.cat([center, features[graph] - center], dim=2)


def distances(x: Tensor, graph: Tensor) -> Tensor:
    """|x_j - o|, |x_j - x_i|, |o - x_i| of every edge, (N, K, 3); o is the origin."""
    to_center = x.norm(dim=1)
    between = (x[graph] - x[:, None, :]).norm(dim=2)
    return torch.stack([to_center[graph], between, to_center[:, None].expand_as(between)], dim=2)


def rotation_matrix(values: Tensor, kind: str) -> Tensor:
    """Rotations (C, 3, 3) from the head's values."""
    if kind == "euler":
        (ca, cb, cc), (sa, sb, sc) = values.cos().unbind(1), values.sin().unbind(1)
        one, zero = torch.ones_like(ca), torch.zeros_like(ca)
        rx = stacked([[one, zero, zero], [zero, ca, -sa], [zero, sa, ca]])
        ry = stacked([[cb, zero, sb], [zero, one, zero], [-sb, zero, cb]])
        rz = stacked([[cc, -sc, zero], [sc, cc, zero], [zero, zero, one]])
        return rx @ ry @ rz
    if kind == "quaternion":
        w, x, y, z = functional.normalize(values + values.new_tensor([1.0, 0, 0, 0]), dim=1).unbind(1)
        return stacked([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])
    if kind == "six_d":
        a, b = (values + values.new_tensor([1.0, 0, 0, 0, 1, 0])).split(3, dim=1)
        x = functional.normalize(a, dim=1)
        y = functional.normalize(b - (x * b).sum(dim=1, keepdim=True) * x, dim=1)
        return torch.stack([x, y, torch.linalg.cross(x, y)], dim=2)
    u, _, vh = torch.linalg.svd(values.view(-1, 3, 3) + torch.eye(3, dtype=values.dtype))
    sign = torch.linalg.det(u @ vh).detach()
    return torch.cat([u[:, :, :2], u[:, :, 2:] * sign[:, None, None]], dim=2) @ vh


def stacked(rows: list[list[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def relative_pose(rotations: Tensor, translations: Tensor) -> tuple[Tensor, Tensor]:
    """R and t of each pair, from the poses of all sources and then all targets."""
    (rx, ry), (tx, ty) = rotations.chunk(2), translations.chunk(2)
    r = ry @ rx.transpose(1, 2)
    return r, ty - (r @ tx[:, :, None])[:, :, 0]


def chamfer_loss(points: Tensor, sizes: list[int], rotations: Tensor, translations: Tensor) -> Tensor:
    """Mean over the pairs of the Chamfer distance between the two canonical shapes."""
    clouds = [(x - t) @ r for x, r, t in zip(points.split(sizes), rotations, translations)]
    pairs = len(clouds) // 2
    loss = points.new_zeros(())
    for x, y in zip(clouds[:pairs], clouds[pairs:]):
        distances_sq = (x[:, None, :] - y[None, :, :]).square().sum(dim=2)
        loss = loss + distances_sq.min(dim=1).values.mean() + distances_sq.min(dim=0).values.mean()
    return loss / pairs


def train_step(
    network: Network, optimizer: torch.optim.Optimizer, points: Tensor, sizes: list[int], graph: Tensor | None = None
) -> float:
    """One step on all sources and then all targets; batch norm sees all clouds together."""
    network.train()
    optimizer.zero_grad()
    loss = chamfer_loss(points, sizes, *network(points, sizes, graph))
    loss.backward()
    optimizer.step()
    return loss.item()


@torch.inference_mode()
def predict(network: Network, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """The pose that lays `source` on `target`: (3, 3), (3)."""
    network.eval()
    rotations, translations = network(torch.cat([source, target]), [len(source), len(target)])
    r, t = relative_pose(rotations, translations)
    return r[0], t[0]
