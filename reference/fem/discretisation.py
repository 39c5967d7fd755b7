"""A body as DOLFINx sees it: mesh, spaces, and the one map between the body's numbers and the unknowns.

Every rank knows the whole body; mesh, matrices and vectors are shared out. "Unknowns" are this rank's own, in PETSc's
order; everything that leaves is in the body's node order, whole on every rank.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body
from softtwin.meshes.elements import Kind, linear_kind

from ..data.loading import checked_array
from ..data.springs import Ligament, Springs, Support, on_surfaces
from .fenicsx import (
    MPI,
    cell_dofs,
    cell_space,
    cell_vertices,
    collapse,
    create_mesh,
    dirichlet,
    exterior_facets,
    facet_measure,
    fem,
    original_cells,
    taylor_hood_space,
    ufl,
    vector_space,
    vtk_order,
)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_AXES = "xyz"


class Discretisation:
    """Mesh, function spaces and numbers of one body.

    Args:
        body: the body.
        mixed: with the pressure as an unknown (Taylor-Hood).
        held: axes held at named node sets, `{"fixed": "xyz"}`.
        comm: ranks that share the mesh.
        springs: that hold named surfaces.
    """

    def __init__(
        self,
        body: Body,
        mixed: bool,
        held: Mapping[str, str],
        comm: Any = MPI.COMM_SELF,
        springs: Mapping[str, Support] | None = None,
    ) -> None:
        self.body, self.mixed, self.comm = body, mixed, comm
        kind = linear_kind(body.kind) if body.is_straight else body.kind
        self.mesh = create_mesh(body.points, body.cells[:, : kind.nodes], kind, comm)
        self.cells = original_cells(self.mesh)
        self._make_spaces()
        self.state = fem.Function(self.space)
        self.held = _held_axes(body, held)
        _check_rigid(body, self.held, springs or {})
        self.band_order: Ints | None = None  # linear.py keeps its order here, for all matrices of the body
        self._hold()

    def _make_spaces(self) -> None:
        dimension = self.body.dimension
        if self.mixed:
            self.space = taylor_hood_space(self.mesh)
            displacements, numbers = collapse(self.space, 0)
            pressures, self._pressure_numbers = collapse(self.space, 1)
            self._pressure_nodes = self._nodes_of(pressures, linear_kind(self.body.kind))
        else:
            self.space = displacements = vector_space(self.mesh, self.body.kind.degree)
            layout = displacements.dofmap.index_map
            numbers = np.arange(dimension * (layout.size_local + layout.num_ghosts))
        self.displacements = displacements
        self.numbers = numbers.reshape(-1, dimension)  # in the whole space, of each component of each local node
        self.local_nodes = self._nodes_of(displacements, self.body.kind)
        self.nodes = self.local_nodes[: displacements.dofmap.index_map.size_local]
        self._all_nodes = self._gathered(self.nodes)
        self.own_numbers = self.numbers[: len(self.nodes)].ravel()
        layout, block = self.space.dofmap.index_map, self.space.dofmap.index_map_bs
        self.owned, self.size = layout.size_local * block, layout.size_global * block

    def _nodes_of(self, space: Any, kind: Kind) -> Ints:
        """Which node of the body each local block of a space is."""
        layout = space.dofmap.index_map
        nodes = np.empty(layout.size_local + layout.num_ghosts, dtype=np.int64)
        nodes[cell_dofs(space)] = self.body.cells[self.cells][:, vtk_order(kind)]
        return nodes

    def _gathered(self, own: NDArray[Any], axis: int = 0) -> NDArray[Any]:
        return own if self.comm.size == 1 else np.concatenate(self.comm.allgather(own), axis)

    def _hold(self) -> None:
        axes = [self.numbers[self.held[self.local_nodes, axis], axis] for axis in range(self.body.dimension)]
        self.conditions = dirichlet(self.space, self.mesh, axes, self.mixed)
        numbers = np.sort(np.concatenate(axes))
        self.fixed = numbers[numbers < self.owned].astype(np.int32)

    # ------------------------------------------------------------------ to unknowns and back

    def unknowns(self, name: str, field: ArrayLike, pressure: Floats | None = None) -> Floats:
        """A nodal field (n, 3) as unknowns, with pressures (n,) where they are unknowns too (zero if not given).

        Raises:
            ValueError: another shape, NaN or infinity.
        """
        out = self.rows(checked_array(name, field, self.body.points.shape)[None])[0]
        if pressure is not None and self.mixed:
            own = self._pressure_numbers < self.owned
            out[self._pressure_numbers[own]] = pressure[self._pressure_nodes[own]]
        return out

    def rows(self, fields: Floats) -> Floats:
        """Nodal fields (k, n, 3) as rows of unknowns, pressures zero."""
        out = np.zeros((len(fields), self.owned))
        out[:, self.own_numbers] = fields[:, self.nodes].reshape(len(fields), -1)
        return out

    def field(self, unknowns: Floats) -> Floats:
        """Unknowns as a nodal field (n, 3), whole on every rank; rows of unknowns as several, (k, n, 3)."""
        return self.nodal(unknowns[..., self.own_numbers])

    def nodal(self, own: Floats) -> Floats:
        """Components of this rank, block by block, as nodal fields (..., n, 3), whole on every rank."""
        rows = own.shape[:-1]
        whole = np.empty((*rows, *self.body.points.shape))
        whole[..., self._all_nodes, :] = self._gathered(own.reshape(*rows, -1, self.body.dimension), axis=-2)
        return whole

    def pressure(self, unknowns: Floats) -> Floats | None:
        """Pressure at the nodes, (n,), linear between the corners; None where it is no unknown."""
        if not self.mixed:
            return None
        own = self._pressure_numbers < self.owned
        whole = np.empty(len(self.body.points))
        whole[self._gathered(self._pressure_nodes[own])] = self._gathered(unknowns[self._pressure_numbers[own]])
        kind = self.body.kind
        for node, group in enumerate(kind.parents, start=kind.corners):
            whole[self.body.cells[:, node]] = whole[self.body.cells[:, list(group)]].mean(axis=1)
        return whole

    @property
    def pressures(self) -> int:
        """How many of the unknowns are pressures."""
        return int(self.size - self.body.points.size)

    def set_state(self, unknowns: Floats) -> None:
        """Make unknowns the state that forms are assembled at."""
        self.set_function(self.state, unknowns)

    def set_function(self, function: Any, unknowns: Floats) -> None:
        """Give a function of the whole space its own unknowns, and its neighbours'."""
        if self.comm.size == 1:
            function.x.array[:] = unknowns
        else:
            function.x.array[: self.owned] = unknowns
            function.x.scatter_forward()

    def dot(self, first: Floats, second: Floats) -> float:
        """Inner product over all ranks."""
        here = float(first @ second)
        return here if self.comm.size == 1 else float(self.comm.allreduce(here))

    def norm(self, unknowns: Floats) -> float:
        """Euclidean norm over all ranks."""
        return float(np.sqrt(self.dot(unknowns, unknowns)))

    # ------------------------------------------------------------------ what forms are made of

    def cell_function(self, values: ArrayLike, name: str = "") -> Any:
        """One number for each cell of the body as a function.

        Raises:
            ValueError: another number of cells.
        """
        array = np.asarray(values, dtype=np.float64)
        if array.shape != (len(self.body.cells),):
            raise ValueError(
                f"{name}: expected one value for each of the {len(self.body.cells)} cells, got shape {array.shape}."
            )
        space = cell_space(self.mesh)
        function = fem.Function(space)
        function.x.array[cell_dofs(space).ravel()] = array[self.cells]
        return function

    def cell_values(self, vector: Any, space: Any) -> Floats:
        """An assembled vector of a space of cells as (cells,), whole on every rank."""
        layout = space.mesh.topology.index_map(space.mesh.topology.dim)
        rows = cell_dofs(space).ravel()[: layout.size_local]
        whole = np.zeros(len(self.body.cells))
        whole[self.cells[: layout.size_local]] = vector.array_r[rows]
        if self.comm.size > 1:
            whole = np.array(self.comm.allreduce(whole))
        return whole

    def gradient(self, displacement: Any) -> Any:
        """Gradient, 3 x 3, of a displacement (UFL); nothing changes along the plane's normal."""
        gradient = ufl.grad(displacement)
        if self.body.dimension == 3:
            return gradient
        (a, b), (c, d) = ([gradient[i, j] for j in range(2)] for i in range(2))
        return ufl.as_tensor([[a, b, 0], [c, d, 0], [0, 0, 0]])

    def deformation_gradient(self, displacement: Any) -> Any:
        """F, 3 x 3, of a displacement (UFL); the plane keeps its thickness."""
        return ufl.Identity(3) + self.gradient(displacement)

    def measure(self, degree: int) -> Any:
        """The volume measure with a given quadrature."""
        return ufl.dx(self.mesh, metadata={"quadrature_degree": degree})

    def facet_measure(self, surface: str, degree: int) -> Any:
        """The measure over a named surface (`boundary` is all of the boundary)."""
        facets, vertices = exterior_facets(self.mesh)
        node = self._vertex_nodes()
        rows = {tuple(sorted(corners)): i for i, corners in enumerate(node[vertices].tolist())}
        wanted = self.body.facets if surface == "boundary" else self.body.facets_of(surface)
        corners = wanted[:, : len(linear_kind(self.body.kind).facets[0])].tolist()
        found = [rows[key] for key in (tuple(sorted(c)) for c in corners) if key in rows]
        return facet_measure(self.mesh, facets[found], degree)

    def _vertex_nodes(self) -> Ints:
        vertices = cell_vertices(self.mesh)
        linear = linear_kind(self.body.kind)
        node = np.empty(vertices.max(initial=-1) + 1, dtype=np.int64)
        node[vertices] = self.body.cells[self.cells][:, vtk_order(linear)]
        return node


def _held_axes(body: Body, held: Mapping[str, str]) -> NDArray[np.bool_]:
    """Which components of which nodes are held, (n, 3)."""
    axes = _AXES[: body.dimension]
    mask = np.zeros(body.points.shape, dtype=bool)
    for name, which in held.items():
        if name not in body.node_sets:
            raise ValueError(f"Problem.held: expected names among {sorted(body.node_sets)}, got {name!r}.")
        if not which or set(which) - set(axes):
            raise ValueError(f"Problem.held[{name!r}]: expected letters of {axes!r}, got {which!r}.")
        for letter in which:
            mask[body.node_sets[name], axes.index(letter)] = True
    return mask


def rigid_motions(points: Floats) -> Floats:
    """Translations and linearised rotations about the centre, (6, n, 3); (3, n, 2) in the plane; of like size."""
    centred = points - points.mean(axis=0)
    centred = centred / max(float(np.abs(centred).max()), np.finfo(float).tiny)
    dimension = points.shape[1]
    motions = [np.broadcast_to(axis, points.shape) for axis in np.eye(dimension)]
    for i, j in ((0, 1), (1, 2), (0, 2))[: 1 if dimension == 2 else 3]:
        turned = np.zeros_like(points)
        turned[:, i], turned[:, j] = -centred[:, j], centred[:, i]
        motions.append(turned)
    return np.array(motions)


def _sprung(body: Body, name: str, springs: Springs, motions: Floats) -> Floats:
    """What springs resist of rigid motions, (m, k): their parts across and along a surface at the facets' corners."""
    facets = body.facets if name == "boundary" else body.facets_of(name)
    corners = facets[:, : len(linear_kind(body.kind).facets[0])]
    edges = body.points[corners[:, 1:]] - body.points[corners[:, :1]]
    normals = np.cross(edges[:, 0], edges[:, 1]) if body.dimension == 3 else edges[:, 0][:, ::-1] * [1.0, -1.0]
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    moved = motions[:, corners]
    across = np.einsum("mfci,fi->mfc", moved, normals)
    along = moved - across[..., None] * normals[:, None]
    parts = [across.reshape(len(motions), -1)] * (springs.normal > 0.0)
    return np.hstack([*parts, *[along.reshape(len(motions), -1)] * (springs.tangential > 0.0)])


def _tied(body: Body, name: str, ligament: Ligament, motions: Floats) -> Floats:
    """What a ligament resists of rigid motions, (m, 3): all where it pulls at rest, none where it is slack."""
    carried = ligament.carried(name, body)
    stiffness = ligament.response(np.zeros(3))[2] / ligament.stiffness
    return np.asarray(np.einsum("k,mki->mi", carried.weights[0], motions[:, carried.nodes[0]]) @ stiffness)


def _check_rigid(body: Body, mask: NDArray[np.bool_], springs: Mapping[str, Support]) -> None:
    if springs and not mask.any() and not on_surfaces(springs):
        raise ValueError(
            "Problem.springs: expected held nodes, or springs on a surface, beside ligaments, got ligaments alone."
        )
    motions = rigid_motions(body.points)
    resisted = (
        _tied(body, name, each, motions) if isinstance(each, Ligament) else _sprung(body, name, each, motions)
        for name, each in springs.items()
    )
    held = np.hstack([motions[:, mask], *resisted])
    left = len(motions) - (int(np.linalg.matrix_rank(held, tol=1e-9 * np.sqrt(len(body.points)))) if held.size else 0)
    if left:
        raise ValueError(
            f"Problem.held: expected no rigid motion to be left, got {left} of {len(motions)} "
            f"(translations and rotations) with {int(mask.any(axis=1).sum())} held nodes and springs on "
            f"{sorted(springs) or 'no surface'}; without a support there is no equilibrium."
        )
