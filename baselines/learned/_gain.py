"""The gain network as it is trained: back-propagation through time through the filter, whose plant is compiled code.

A step of the filter is one `torch.autograd.Function`: forward it runs `gain_filter` on NumPy, backward it goes through the
same samples with the exact Jacobians F of the prediction and H of the sensors,

    dX+ = (I - K H) F dX + dK nu,

where the nominal gain is taken as given: on a plant that is linear in [x; z] but for products with the command it does not
depend on the estimate, elsewhere what it does is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from baselines.learned import flights as data
from baselines.learned import gain_filter as gain
from baselines.learned._supervised import SupervisedTraining
from baselines.learned.features import deviation
from baselines.learned.flights import Flights
from baselines.learned.gain_net import Nominal, nominal_of, nominal_tensors
from baselines.learned.sequence_net import LOG_STD
from fdi_gym.diagnosis import NotApplicableError
from fdi_gym.diagnosis.fitting import fit_belief
from fdi_gym.engine import Record
from fdi_gym.estimation.augmented import AugmentedModel
from fdi_gym.estimation.interval import Interval
from fdi_gym.plant import Array, Plant

STANDARD = 24  # flights per condition from which the features are standardised


class Stream:
    """The samples of n recorded flights (n, K + 1, n_obs), `stride` a step, and the nominal covariance: no gradient."""

    def __init__(self, model: AugmentedModel, obs: Array, stride: int):
        self.model, self.obs, self.stride, self.k = model, obs, stride, 0
        self.P = np.tile(model.P0, (len(obs), 1, 1))
        self.newest = self.before = gain.at_rest(model, len(obs))

    def sample(self) -> tuple[Interval, Array, Array]:
        """The next sample: its interval, y and which sensors reported."""
        plant, k, n_y, n_u = self.model.plant, self.k, len(self.model.plant.outputs), len(self.model.plant.commands)
        now, number = self.obs[:, k], np.full(len(self.obs), k)
        known, d = now[:, n_y + n_u :], None
        if plant.measured_disturbance is not None:
            earlier = self.obs[:, max(k - 1, 0), n_y + n_u :]
            d = plant.measured_disturbance((number - 1) * plant.dt, earlier, known)  # type: ignore[arg-type]
        seen = ~np.isnan(now[:, :n_y])
        y = np.where(seen, now[:, :n_y], 0.0)
        self.newest, self.k = gain.newest(self.model, self.newest, y, seen), k + 1
        return Interval(number, np.ascontiguousarray(now[:, n_y : n_y + n_u]), d, known), y, seen


def jacobian_of(model: AugmentedModel, X: Array, at: Interval) -> Array:
    """The Jacobian of the prediction at X (n, N): (n, N, N); read off where x+ = g + A x + B u + G d + E(u) z."""
    packed = model.compiled.linear
    if not packed.size:
        return model.jacobian_f(X, at)[1]
    n_x, n_u, n_d, p = model.x.stop, len(model.plant.commands), len(model.plant.disturbances), model.z.stop - model.z.start
    _, A, _, G, E = np.split(packed, np.cumsum([1, n_x, n_u, n_d]), axis=1)  # as `gaussian_model` packs them
    gain_z = E.reshape(n_x, 1 + n_u, p)
    found = np.tile(np.eye(X.shape[1]), (len(X), 1, 1))
    found[:, :n_x, :n_x] = A
    found[:, :n_x, model.z] = gain_z[:, 0] + np.tensordot(at.u, gain_z[:, 1:], axes=(1, 1))
    found[:, :n_x, model.d] = G[:, model.disturbances]
    return found


class FilterStep(torch.autograd.Function):
    """A step of several samples: X (n, N) and factor (n, rows, m) -> X, and what is shown (n, all of the layout)."""

    @staticmethod
    def forward(ctx: Any, X: Tensor, factor: Tensor, stream: Stream, at_end: gain.Layout) -> tuple[Tensor, Tensor]:
        """Run the filter over the next samples of the stream."""
        model, x, before, E = stream.model, X.detach().numpy(), X.detach().numpy(), factor.detach().numpy()
        rows, m, tape = E.shape[1], len(model.R), []
        total = np.zeros((len(x), 3 * m + rows + model.z.stop - model.z.start))
        u, known = stream.obs[:, 0, :0], stream.obs[:, 0, :0]
        for _ in range(stream.stride):
            at, y, seen = stream.sample()
            jacobian = None
            if stream.k > 1:
                jacobian = jacobian_of(model, x, at)
                x, stream.P = gain.predicted(model, x, stream.P, at)
            c = gain.corrected(model, x, stream.P, at, y, seen, E)
            total = gain.added(model, total, c, E)
            tape.append((jacobian, c))
            x, stream.P, u, known = c.X, c.P, at.u, at.known
        raw = gain.shown(model, at_end.sets, total, x, before, stream.P, stream.newest - stream.before, u, known)
        stream.before = stream.newest
        ctx.tape, ctx.factor, ctx.model, ctx.layout = tape, E, model, at_end
        return torch.from_numpy(x), torch.from_numpy(raw)

    @staticmethod
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor, Tensor, None, None]:  # type: ignore[override]
        """The same samples the other way round."""
        model, E, (gX, raw) = ctx.model, ctx.factor, (slope.numpy() for slope in slopes)
        at, rows, n_x = ctx.layout, E.shape[1], model.x.stop
        gX, gE = gX.copy(), np.zeros_like(E)
        gX[:, :rows] += raw[:, at.estimate]
        gX[:, :n_x] += raw[:, at.moved]
        end = ctx.tape[-1][1]
        gX[:, model.z] += (raw[:, None, at.distance] @ gain.distance_slopes(model, at.sets, end.X, end.P))[:, 0]
        for jacobian, c in reversed(ctx.tape):
            g = gX * c.kept
            whole = g[:, :rows] + raw[:, at.update]  # of factor * K nu
            nominal = c.K[:, :rows]
            gE += nominal * (whole[..., None] * c.nu[:, None])
            g_nu = ((E * nominal).transpose(0, 2, 1) @ whole[..., None])[..., 0]
            g_nu += (c.K[:, rows:].transpose(0, 2, 1) @ g[:, rows:, None])[..., 0]
            g_nu += (c.K[:, model.z].transpose(0, 2, 1) @ (raw[:, at.score] / gain.spread(model, c.P))[..., None])[..., 0]
            g_nu += raw[:, at.white] / c.std + 2 * raw[:, at.energy] * c.nu / c.std**2
            g_nu *= c.seen
            gX = g - (g_nu[:, None] @ c.H)[:, 0]
            if jacobian is not None:
                gX = (gX[:, None] @ jacobian)[:, 0]
        gX[:, :n_x] -= raw[:, at.moved]
        return torch.from_numpy(gX), torch.from_numpy(gE), None, None


class GainNetwork(nn.Module):
    """Gains of the steps to come, and the label of each step; `gain_net.forward` runs it step by step, without torch.

    Args:
        nominal: The filter that it corrects, and how its features are standardised.
        stride: Samples per step.
        labels: Labels of the isolation task.
        hidden: Width of every layer.
        processes: Fault processes that it is told of.
    """

    def __init__(self, nominal: Nominal, stride: int, labels: int, hidden: int, processes: int):
        super().__init__()
        model = nominal.model
        self.nominal, self.stride, self.labels, self.processes = nominal, stride, labels, processes
        self.hidden, self.rows, self.m = hidden, model.z.stop, len(model.R)
        width = len(nominal.mean) + processes
        self.value, self.gate = nn.Linear(width, hidden), nn.Linear(width, hidden)
        self.join = nn.Linear(width + hidden, hidden)
        self.memory = nn.GRUCell(hidden, hidden)
        self.read = nn.Linear(hidden, hidden)
        self.heads = nn.Linear(hidden, labels + self.rows)
        self.gain = nn.Linear(hidden, self.rows * self.m)
        nn.init.zeros_(self.gain.weight)  # it begins as the nominal filter
        nn.init.zeros_(self.gain.bias)

    def seen(self, x: Tensor) -> Tensor:
        """Features (..., n) as the memory takes them."""
        product = self.value(x) * torch.tanh(self.gate(x))
        return F.silu(self.join(torch.cat([x, product], dim=-1)))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Observations (N, steps, stride * n_obs + processes): logits, estimate of [z; x], log std, features, per step.

        The estimate is in units of the data sheet's scales, off the healthy value and off the trim.
        """
        nominal, n = self.nominal, len(x)
        model, kind = nominal.model, self.heads.weight.dtype
        obs = x[..., : -self.processes].numpy().reshape(n, x.shape[1] * self.stride, -1)
        told = x[:, 0, -self.processes :].to(kind)
        unit, mean, std = (torch.from_numpy(a) for a in (nominal.layout.unit, nominal.mean, nominal.std))
        reach = torch.from_numpy(gain.reach(model)).to(kind)[:, None]
        stream = Stream(model, obs, self.stride)
        X, h = torch.from_numpy(np.tile(model.X0, (n, 1))), torch.zeros(n, self.hidden, dtype=kind)
        factor = torch.ones(n, self.rows, self.m, dtype=X.dtype)
        out, estimates, shown = [], [], []
        for _ in range(x.shape[1]):
            X, raw = FilterStep.apply(X, factor, stream, nominal.layout)  # type: ignore[misc]
            own = ((torch.asinh(raw / unit) - mean) / std).clamp(-gain.CLIP, gain.CLIP).to(kind)
            seen = self.seen(torch.cat([own, told], dim=1))
            h = self.memory(seen, h)
            read = F.silu(self.read(seen + h))
            log = reach * torch.tanh(self.gain(read)).reshape(n, self.rows, self.m)
            factor = torch.exp(log).to(X.dtype)
            out.append(self.heads(read))
            estimates.append(X)
            shown.append(own)
        heads, X = torch.stack(out, dim=1), torch.stack(estimates, dim=1)
        logits, log_std = heads.split([self.labels, self.rows], dim=-1)
        off = (X[..., : self.rows] - torch.from_numpy(nominal.rest)) / torch.from_numpy(nominal.scale)
        return logits, off.to(kind), log_std.clamp(*LOG_STD), torch.stack(shown, dim=1)


class GainTraining(SupervisedTraining):
    """Supervised training through the filter; arguments as in `Training`."""

    nominal: Nominal

    def begin(self) -> None:
        """What is believed of the plant, how the features are standardised, and a new network."""
        r = self.recipe
        if any(dict(plant.options) != dict(self.plant.options) for plant in self.plants):
            raise NotApplicableError("gain_net corrects one filter: the processes have the same options of the plant")
        records = self.flown(self.first, r.identify)
        prior = np.stack([np.bincount(f.label.ravel(), minlength=len(self.plant.labels)) / f.label.size for f in records])
        self.prior, self.share = np.maximum(prior, 1e-4), prior
        if r.candidates > 1:
            planned = enumerate(zip(self.plants, r.conditions, strict=True))
            self.share = np.stack([data.label_share(p, c, self.seeds_of(0, i)) for i, (p, c) in planned])
        nominal = nominal_of(self.plant, fit_belief(self.plant, r.conditions[0].process), r.shape.stride)
        few = data.joined([self.shown(i, record, STANDARD) for i, record in enumerate(records)])
        self.start(nominal)
        with torch.inference_mode():
            found = self.network(torch.from_numpy(few.features))[3].numpy().astype(float).reshape(-1, len(nominal.mean))
        self.start(nominal._replace(mean=found.mean(axis=0), std=found.std(axis=0) + 1e-2))

    def start(self, nominal: Nominal) -> None:
        """The network and its optimiser."""
        p, r = self.plant, self.recipe
        torch.manual_seed(self.seed)
        self.nominal = nominal
        self.network = GainNetwork(nominal, r.shape.stride, len(p.labels), r.hidden, len(r.conditions))  # type: ignore
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=r.rate, weight_decay=r.decay)

    def state(self) -> dict[str, Array]:
        """The nominal filter, and the shares of the labels."""
        return {**nominal_tensors(self.nominal), "prior": self.prior, "share": self.share}

    def restore(self, tensors: Mapping[str, Array]) -> None:
        """As `begin` has left it."""
        self.prior, self.share = tensors["prior"], tensors["share"]
        self.start(nominal_of(self.plant, tensors, self.recipe.shape.stride))

    # -- flights

    def shown(self, index: int, record: Record, count: int | None = None) -> Flights:
        """Recorded flights under a condition: observations and process per step, and the truth of z and x."""
        plant, condition, stride = self.plants[index], self.recipe.conditions[index], self.recipe.shape.stride
        record = record if count is None else Record(*(a[:count] for a in record))
        n, samples, width = record.obs.shape
        steps = samples // stride
        obs = record.obs[:, : steps * stride].reshape(n, steps, stride * width)
        told = data.context(np.full(n, index), len(self.plants), steps).astype(float)
        truth = np.concatenate([state_deviation(plant, record.state), deviation(plant, record.target)], axis=2)
        parts = (record.label, truth, data.scored_of(plant, condition, record))
        label, truth, scored = (data.at_steps(a, stride)[:, :steps] for a in parts)
        return Flights(np.concatenate([obs, told], axis=2), label, truth.astype(np.float32), scored, np.full(n, index))

    def prepared(self, seeds: Sequence[Sequence[int]]) -> tuple[Flights, list[Record]]:
        """Flights under all conditions, as the network sees them; seeds per condition."""
        pairs = zip(self.plants, self.recipe.conditions, seeds, strict=True)
        records = [data.fly(plant, condition, own) for plant, condition, own in pairs]
        return data.joined([self.shown(i, record) for i, record in enumerate(records)]), records

    def chunk(self, index: int) -> Flights:
        """The training flights of one chunk, in some of which sensors are silent now and then; kept until the next."""
        if self.newest is None or self.newest[0] != index:
            flown = super().chunk(index)
            rng = np.random.default_rng([self.seed, index, 1])
            silent = silences(rng, len(flown.label), flown.label.shape[1] * self.recipe.shape.stride, self.plant)
            shape = (len(flown.label), flown.label.shape[1], self.recipe.shape.stride, -1)
            obs = flown.features[..., : -len(self.plants)].reshape(shape)
            obs[..., : len(self.plant.outputs)][silent.reshape(*shape[:3], -1)] = np.nan
            seen = np.concatenate([obs.reshape(*shape[:2], -1), flown.features[..., -len(self.plants) :]], axis=2)
            self.newest = index, flown._replace(features=seen)
        return self.newest[1]

    # -- the end

    def tensors(self) -> dict[str, Array]:
        """The network and the nominal filter."""
        network = {f"network.{name}": value.cpu().numpy() for name, value in self.network.state_dict().items()}
        return network | nominal_tensors(self.nominal)

    def card(self) -> dict[str, Any]:
        """As of every network that is trained under supervision, with a shape of its own."""
        return super().card() | {"shape": {"stride": self.recipe.shape.stride, "hidden": self.recipe.hidden}}


def state_deviation(plant: Plant, x: Array) -> Array:
    """The state (..., n_x) off the trim, in units of the data sheet's scales."""
    return (x - plant.trim_state) / np.array([s.scale for s in plant.states])


def silences(rng: np.random.Generator, n: int, samples: int, plant: Plant, share: float = 0.3) -> Array:
    """Which sensors are silent in n flights (n, samples, n_y): in a share of them single ones at random, and all in gaps."""
    n_y = len(plant.outputs)
    rate = np.where(rng.random(n) < share, rng.uniform(0.0, 0.4, n), 0.0)
    silent = rng.random((n, samples, n_y)) < (rate * (rng.random(n) < 0.5))[:, None, None]
    for i in np.flatnonzero(rate):
        for begin, length in zip(rng.integers(0, samples, 6), rng.integers(1, 40, 6), strict=True):
            silent[i, begin : begin + length, rng.random(n_y) < 0.7] = True
    return silent
