"""The Galerkin model's basis: modes of typical loads, their modal derivatives, and what own equilibria add to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softtwin.meshes.body import Body
from softtwin.reference.data.dataset import DataSet, Samples, stored_plans
from softtwin.reference.data.materials import MATERIALS, Material, with_parameters
from softtwin.reference.data.samplers import LoadPlan, draw_load, draw_smooth_load
from softtwin.reference.data.springs import ligaments_of, on_surfaces

from .architecture import NewSamples
from .cubature import sparse_weights
from .encoder_decoder import LinearEncoderDecoder, response_parts
from .modal_derivatives import FactoredTangent, leading_modes, modal_derivatives, without
from .reduced_equilibria import GalerkinNetwork
from .residual import ElasticBody
from .tangents import layers_of
from .warping import Warping

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Singles = NDArray[np.float32]
_VARIED = {"poisson-ratio": "poisson_ratio", "young-modulus": "young_modulus"}
_SPRINGS = "springs"
_MODES_MORE, _DERIVATIVES_MORE, _CELLS_MORE = 5, 6, 60  # for each tissue beside the expected one
_NOTHING = 1e-8  # of fields, that what they have outside of a basis is more than
_INSIDE = 0.3  # of a whole body's forces, that those of a structure count as
_LOADS = 128  # typical loads, that nothing is solved for but linear responses
_LEAST_SHARE = 0.2  # of the usual top, that the smallest of them are
_STATES = 48  # of typical loads, that the cells are chosen by
_SKETCH = 2500  # combinations of what the cells are chosen by (count sketch: Charikar, Chen, Farach-Colton 2004)
_OWN, _TANGENTS = 32, 24  # equilibria, at most, that the basis is told of, and whose tangents
# Adapting while it is used: modes that are pushed, at so many states; modes and cells then.
_PUSHED, _PUSHED_AT, _NEW_MODES, _NEW_CELLS, _NEW_TOLERANCE = 16, 4, 36, 600, 0.001
_CHANGES, _SEEN = 6, 64  # changes of each state that modes are told of; newest states that cells are chosen by


@dataclass(frozen=True, eq=False)
class Variation:
    """A tissue, or a support, that the model is to know beside the one that is expected.

    Args:
        material: the law with its parameters.
        parameters: those that differ, one for each cell of the body.
        cells: numbers of the cells where they do; None for all.
        springs: how many times as stiff as expected springs are, by the surface that they hold; others as expected.
    """

    material: Material
    parameters: Mapping[str, Floats] = field(default_factory=dict)
    cells: Ints | None = None
    springs: Mapping[str, float] = field(default_factory=dict)

    def of(self, elastic: ElasticBody) -> ElasticBody:
        """A body with it."""
        return elastic.with_material(self.material).with_springs(self.springs)


@dataclass(frozen=True)
class Galerkin:
    """The Galerkin model's settings: equilibria in the span of a few modes, by a few cells. Nothing is trained.

    Args:
        modes: linear modes of typical loads.
        curved: so many of them, the first, have modal derivatives.
        derivatives: modes of these that are kept.
        own: modes of what the equilibria of the training split, and their tangents, add; 0 leaves them out.
        cells: that stand for the body, about.
        tolerance: of internal forces by these cells, relative, below which no more are taken.
        vary: least and largest value of what is not known of the tissue, by name: `poisson-ratio`, `young-modulus`, or
            `young-modulus@STRUCTURE` of what lies in a closed inner surface; of `springs@SURFACE`, how many times as
            stiff they may be. States may be asked for with any of it.

    Raises:
        ValueError: an argument out of its range.
    """

    modes: int = 20
    curved: int = 16
    derivatives: int = 36
    own: int = 16
    cells: int = 300
    tolerance: float = 0.005
    vary: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    name: ClassVar[str] = "galerkin"
    rehearsed: ClassVar[int] = 16

    def __post_init__(self) -> None:
        for name in ("modes", "curved", "cells"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise ValueError(f"Galerkin.{name}: expected a whole number of at least 1, got {getattr(self, name)}.")
        for name in ("derivatives", "own"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 0:
                raise ValueError(f"Galerkin.{name}: expected a whole number of at least 0, got {getattr(self, name)}.")
        if not 0.0 < self.tolerance < 1.0:
            raise ValueError(f"Galerkin.tolerance: expected a number between 0 and 1, got {self.tolerance}.")
        for name, ends in self.vary.items():
            kind, _, place = name.partition("@")
            takes_place = kind in ("young-modulus", _SPRINGS)
            if kind not in (*_VARIED, _SPRINGS) or (place and not takes_place) or (kind == _SPRINGS and not place):
                raise ValueError(
                    f"Galerkin.vary: expected {', '.join(_VARIED)}, young-modulus@STRUCTURE or springs@SURFACE, got "
                    f"{name!r}."
                )
            if len(ends) != 2 or not 0.0 < ends[0] < ends[1] < np.inf:
                raise ValueError(f"Galerkin.vary: expected two growing positive numbers for {name}, got {list(ends)}.")
            if kind == _SPRINGS and not ends[0] <= 1.0 <= ends[1]:
                raise ValueError(
                    f"Galerkin.vary: expected a range of {name} that holds 1, as stiff as they are, got {list(ends)}."
                )
            if kind == "poisson-ratio" and ends[1] >= 0.5:
                raise ValueError(f"Galerkin.vary: expected Poisson's ratios below 0.5, got {list(ends)}.")

    def check(self, body: Body) -> None:
        """Any body in space will do that has the structures which `vary` names.

        Raises:
            ValueError: a plane body, or no such structure.
        """
        for name in self.vary:
            if not is_of_springs(name):
                varied(name, body)
        if body.dimension != 3:
            raise ValueError(f"Galerkin.body: expected a body in space, got one of {body.dimension} dimensions.")

    def fitted(self, data: DataSet, train: Samples) -> tuple[LinearEncoderDecoder, GalerkinNetwork]:
        """The maps around the network, and the network, which is ready.

        Args:
            data: for body, material, linear response and how loads are drawn.
            train: equilibria that are known.

        Raises:
            ValueError: a law that is not one of `MATERIALS`, or ligaments, whose forces no cell carries.
        """
        law = _law_of(data)
        cords = sorted(ligaments_of(data.springs))
        if cords:
            raise ValueError(
                f"Galerkin.data: expected springs on surfaces alone, got the ligaments {cords}; "
                "learn a network (architecture reduced), or register with --model torch or reference."
            )
        variations = self.variations(data.body, data.material, sorted(on_surfaces(data.springs)))
        elastic = ElasticBody(data.body, data.material, springs=data.springs)
        bodies = [elastic, *(each.of(elastic) for each in variations)]
        loads = _spread(data, typical_loads(data, train))
        tangents = [FactoredTangent(body) for body in bodies]
        linear = [tangent.inverse(loads.T).T for tangent in tangents]
        own = train.displacements[:_OWN]
        basis = self.basis(tangents, linear, own)
        basis.reshape(-1, 3, basis.shape[1])[data.body.fixed] = 0.0  # rounding leaves 1e-17
        states = [_warped(body, fields, data.body.size) for body, fields in zip(bodies, linear, strict=True)]
        states[0] = np.concatenate([states[0], own.reshape(len(own), -1)])
        network = self._network(law, elastic, basis, states, variations)
        left, right = response_parts(data.response)
        at_loaded = basis.reshape(-1, 3, basis.shape[1])[data.response.loaded].reshape(-1, basis.shape[1])
        encode = np.ascontiguousarray(at_loaded.T)
        return LinearEncoderDecoder(data.response.loaded, np.zeros(len(left)), left, right, encode, basis), network

    def variations(self, body: Body, material: Material, springs: Sequence[str] = ()) -> list[Variation]:
        """The tissue, or the support, at either end of each range.

        Args:
            body: that has the structures which `vary` names.
            material: the tissue as it is expected.
            springs: the surfaces that springs hold.

        Raises:
            ValueError: no such structure, no such springs, a range that the law refuses, or that does not hold what is
                expected.
        """
        found = []
        for name, ends in self.vary.items():
            if is_of_springs(name):
                found += _on_other_springs(name, ends, material, springs)
                continue
            parameter, cells = varied(name, body)
            expected = np.broadcast_to(np.asarray(material.parameters[parameter], dtype=np.float64), len(body.cells))
            here = expected if cells is None else expected[cells]
            if not (min(ends) <= here.min() and here.max() <= max(ends)):
                raise ValueError(
                    f"Galerkin.vary: expected a range of {name} that holds what the tissue has, {here.min():g} to "
                    f"{here.max():g}, got {ends[0]:g} to {ends[1]:g}."
                )
            for end in ends:
                values = expected.copy()
                values[slice(None) if cells is None else cells] = end
                found.append(Variation(with_parameters(material, {parameter: values}), {parameter: values}, cells))
        return found

    def basis(self, tangents: Sequence[FactoredTangent], linear: Sequence[Floats], own: Floats) -> Floats:
        """Orthonormal displacements, (3n, r).

        Args:
            tangents: of the body at rest: as it is expected, and with each of the other tissues.
            linear: responses of each to typical loads, (m, 3n), metres.
            own: equilibria, (s, n, 3), metres.
        """
        others = len(tangents) - 1
        pairs = [self._modes(*pair) for pair in zip(tangents, linear, strict=True)]
        modes, curved = pairs[0][0], np.concatenate([each[1] for each in pairs])
        found = modes
        if others:
            apart = [without(fields / _root_sizes(fields), modes) for fields in linear[1:]]
            found = _joined(found, leading_modes(np.concatenate(apart), _MODES_MORE * others))
        count = self.derivatives + (_DERIVATIVES_MORE * others if self.derivatives else 0)
        found = _joined(found, leading_modes(without(curved, found), count))
        if self.own and len(own):
            spread = np.sqrt(np.square(linear[0] @ modes).mean(axis=0))
            scaled = []
            for fields in self._own_fields(tangents[0], modes * spread, own):
                outside = without(fields, found)
                size = float(np.linalg.norm(outside))
                if size > _NOTHING * float(np.linalg.norm(fields)):  # less is rounding's
                    scaled.append(outside / size)
            if scaled:
                found = _joined(found, leading_modes(np.concatenate(scaled), self.own))
        return found

    def _modes(self, tangent: FactoredTangent, linear: Floats) -> tuple[Floats, Floats]:
        """Linear modes, (3n, m), and the modal derivatives of the first of them, (d, 3n)."""
        modes = leading_modes(linear / _root_sizes(linear), self.modes)
        spread = np.sqrt(np.square(linear @ modes).mean(axis=0))
        return modes, modal_derivatives(tangent, modes[:, : self.curved] * spread[: self.curved])

    def _own_fields(self, tangent: FactoredTangent, modes: Floats, own: Floats) -> tuple[Floats, Floats]:
        """Equilibria, (s, 3n), and small changes of them under the forces of linear modes, (m, 3n)."""
        flat = own.reshape(len(own), -1)
        at_rest = tangent.elastic.stiffness(torch.zeros(tangent.elastic.nodes, 3, dtype=torch.float64))
        forces = at_rest @ modes[:, : self.curved]
        changes = [np.zeros((0, flat.shape[1]))]
        for state in own[:_TANGENTS]:
            if not bool((tangent.elastic.jacobians(torch.from_numpy(state[None].copy())) > 0.0).all()):
                continue  # of another simulator: no state of this body
            try:
                fields = FactoredTangent(tangent.elastic, state).inverse(forces).T
            except RuntimeError:  # exactly singular: at a bifurcation
                continue
            changes.append(fields / _root_sizes(fields))
        return flat / _root_sizes(flat), np.concatenate(changes)

    def _network(
        self,
        law: str,
        elastic: ElasticBody,
        basis: Floats,
        states: Sequence[Floats],
        variations: Sequence[Variation],
    ) -> GalerkinNetwork:
        slopes, weights = slopes_of(elastic, basis), elastic.volumes.reshape(-1)
        points = elastic.volumes.shape[1]
        parameters = {
            name: getattr(elastic, f"parameter_{name}").expand(len(elastic.volumes), points).reshape(-1)
            for name in elastic.material.parameters
        }
        cells = torch.arange(len(elastic.volumes)).repeat_interleave(points)
        whole = GalerkinNetwork(
            law, parameters, slopes, weights, support_of(elastic, basis), cells, len(elastic.volumes)
        )

        def parts() -> Iterator[Singles]:
            for state in states[0]:
                yield whole.shares(torch.from_numpy(state @ basis))
            for each, fields in zip(variations, states[1:], strict=True):
                changed = whole.with_parameters(each.parameters).with_springs(each.springs)
                for state in fields:
                    share = changed.shares(torch.from_numpy(state @ basis))
                    yield share
                    if each.cells is not None:  # a structure's own part is kept, too, however small it is
                        inside = share * np.isin(cells.numpy(), each.cells)
                        yield inside * (_INSIDE / max(float(np.linalg.norm(inside.sum(axis=1))), 1e-300))

        most = self.cells + _CELLS_MORE * len(variations)
        taken, factors, _ = sparse_weights(_sketched(parts(), basis.shape[1]), self.tolerance, most)
        chosen = torch.from_numpy(taken)
        return GalerkinNetwork(
            law,
            {name: values[chosen] for name, values in parameters.items()},
            slopes[chosen],
            weights[chosen] * torch.from_numpy(factors),
            support_of(elastic, basis),
            cells[chosen],
            len(elastic.volumes),
        )

    @staticmethod
    def adapted(
        encoder_decoder: LinearEncoderDecoder, network: GalerkinNetwork, samples: NewSamples
    ) -> tuple[LinearEncoderDecoder, GalerkinNetwork]:
        """With modes of equilibria that are new, and of how they change, and cells chosen anew by them.

        Args:
            encoder_decoder: the maps around the network.
            network: as it was made.
            samples: the equilibria.
        """
        elastic, old = samples.elastic, encoder_decoder.decode
        assert old is not None
        law = bytes(network.law.tolist()).decode()
        own, pushed = samples.displacements, [samples.displacements / _root_sizes(samples.displacements)]
        changes = np.concatenate([each[:_CHANGES] for each in samples.changes])
        pushed.append(changes / _root_sizes(changes))
        forces = elastic.stiffness(torch.zeros(elastic.nodes, 3, dtype=torch.float64)) @ old[:, :_PUSHED]
        for place in np.unique(np.linspace(0, len(own) - 1, _PUSHED_AT).astype(int)):
            fields = FactoredTangent(elastic, own[place].reshape(-1, 3)).inverse(forces).T
            pushed.append(fields / _root_sizes(fields))
        outside = [without(fields, old) for fields in pushed]
        scaled = [fields / max(float(np.linalg.norm(fields)), 1e-300) for fields in outside]
        more = without(leading_modes(np.concatenate(scaled), _NEW_MODES).T, old).T
        basis = np.hstack([old, np.linalg.qr(more)[0]])
        basis.reshape(-1, 3, basis.shape[1])[~elastic.free[:, 0].numpy().astype(bool)] = 0.0
        settings = Galerkin(cells=_NEW_CELLS, tolerance=_NEW_TOLERANCE)
        found = settings._network(
            law, elastic, basis, [np.concatenate([own[-_SEEN:], samples.known_displacements])], []
        )
        at_loaded = basis.reshape(-1, 3, basis.shape[1])[encoder_decoder.loaded].reshape(-1, basis.shape[1])
        return replace(encoder_decoder, encode=np.ascontiguousarray(at_loaded.T), decode=basis), found

    @staticmethod
    def from_state_dict(tensors: Mapping[str, Tensor]) -> GalerkinNetwork:
        """The network from what its `state_dict` was."""
        return GalerkinNetwork.from_state_dict(tensors)


def is_of_springs(name: str) -> bool:
    """Whether a name of `vary` is of springs."""
    return name.partition("@")[0] == _SPRINGS


def _on_other_springs(
    name: str, ends: tuple[float, float], material: Material, springs: Sequence[str]
) -> list[Variation]:
    place = name.partition("@")[2]
    if place not in springs:
        raise ValueError(f"Galerkin.vary: expected springs@ one of {list(springs)}, got {name!r}.")
    return [Variation(material, springs={place: end}) for end in ends]


def varied(name: str, body: Body) -> tuple[str, Ints | None]:
    """The parameter of the law that a name stands for, and the cells where it is meant; None for all.

    Raises:
        ValueError: no such structure.
    """
    kind, _, place = name.partition("@")
    if not place:
        return _VARIED[kind], None
    from softtwin.meshes.signed import cells_inside  # VTK: prediction on a machine without it never comes here

    return _VARIED[kind], cells_inside(body, place)


def typical_loads(data: DataSet, train: Samples) -> Floats:
    """Forces at the loaded nodes, (m, l, 3), newtons, as they are drawn and as registration expects them.

    Sizes are those of the training draws by their linear response. Where the data set does not say how loads are drawn
    they are those of the training.

    Args:
        data: the data set.
        train: its training samples.
    """
    plans = stored_plans(data.header, "train")
    if not plans or not plans[0].get("loads"):
        return train.forces[:_LOADS]
    drawn = [_load_plan(each["loads"]) for each in plans if each.get("loads")]
    known = data.response.apply(train.forces[:_LOADS])
    top = float(np.linalg.norm(known, axis=2).max(axis=1).max())
    found = []
    for number in range(_LOADS):
        rng = np.random.default_rng([0, number])
        plan = drawn[number // 2 % len(drawn)]  # of merged sets all in turn
        load = draw_smooth_load(data.body, plan, rng) if number % 2 else draw_load(data.body, data.shapes, plan, rng)
        at_loaded = load[data.response.loaded]
        peak = float(np.linalg.norm(data.response.apply(at_loaded[None])[0], axis=1).max())
        found.append(at_loaded * (rng.uniform(_LEAST_SHARE, 1.0) * top / max(peak, 1e-300)))
    return np.stack(found)


def _load_plan(entries: Mapping[str, Any]) -> LoadPlan:
    return LoadPlan(**{**entries, "zones": tuple(entries["zones"]), "radius": tuple(entries["radius"])})


def _law_of(data: DataSet) -> str:
    for name, kind in MATERIALS.items():
        if type(data.material) is kind and not data.material.is_mixed:
            return name
    raise ValueError(f"Galerkin.data: expected a law among {sorted(MATERIALS)}, got {type(data.material).__name__}.")


def _spread(data: DataSet, forces: Floats) -> Floats:
    """Forces at all nodes, (m, 3n)."""
    return data.response.spread(forces).reshape(len(forces), -1)


def _sketched(parts: Iterable[Singles], size: int) -> Singles:
    """Rows of all parts, or fewer signed sums of them that have the same scalar products in the mean.

    Args:
        parts: (r, c) each.
        size: r.
    """
    rng, groups = np.random.default_rng(0), max(1, _SKETCH // size)
    sums: list[Singles] = []
    for number, part in enumerate(parts):
        signed = rng.choice([-1.0, 1.0], size=(size, 1)).astype(np.float32) * part
        if number < groups:
            sums.append(signed)
        else:
            sums[number % groups] += signed
    return np.concatenate(sums)


def _root_sizes(fields: Floats) -> Floats:
    """Roots of the fields' norms, (m, 1): what is divided by them counts by its size, not by its square."""
    return np.sqrt(np.maximum(np.linalg.norm(fields, axis=1, keepdims=True), 1e-300))


def _joined(modes: Floats, more: Floats) -> Floats:
    return np.linalg.qr(np.hstack([modes, more]))[0]


def slopes_of(elastic: ElasticBody, basis: Floats) -> Tensor:
    """Gradients of modes, (3n, r), at the points of the quadrature, (p, 9, r), 1/m."""
    size = basis.shape[1]
    nodal = torch.from_numpy(basis.reshape(-1, 3, size))[elastic.cells]
    return torch.einsum("ckir,cqkj->cqijr", nodal, elastic.gradients).reshape(-1, 9, size)


def support_of(elastic: ElasticBody, basis: Floats) -> dict[str, Tensor]:
    """Stiffness of the springs between modes, (r, r), N/m, as they were given, by the surface that they hold."""
    nodal = torch.from_numpy(basis.reshape(-1, 3, basis.shape[1]))[elastic.cells[elastic.sprung]].flatten(1, 2)
    return {
        name: torch.einsum("cir,cij,cjs->rs", nodal, part, nodal)
        for name, part in zip(elastic.springs, elastic.spring_parts, strict=True)
    }


def _warped(elastic: ElasticBody, linear: Floats, size: float) -> Floats:
    """Typical displacements, (m, 3n): linear responses with their turns made finite."""
    some = linear[np.linspace(0, len(linear) - 1, min(_STATES, len(linear))).astype(int)]
    if elastic.material.is_linear:
        return some
    layers = layers_of(elastic.cells.numpy(), elastic.free[:, 0].numpy() > 0.0)
    warped = Warping(elastic, layers, size).warped(torch.from_numpy(some.reshape(len(some), -1, 3)))
    return warped.reshape(len(some), -1).numpy()
