"""A twin in Python: open a folder, predict, register a cloud or a stream of them, ask where the structures are."""

from __future__ import annotations

import copy
import gc
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softtwin.meshes.body import Body, Surface
from softtwin.meshes.clouds import CloudError
from softtwin.meshes.embedding import Embedding, is_carried_along, outer, target_points
from softtwin.meshes.export import Coordinates
from softtwin.meshes.io import read_body
from softtwin.reference.data.discrepancy import Discrepancy, read_discrepancy
from softtwin.reference.data.outcome import NotConverged
from softtwin.reference.data.samplers import loaded_nodes
from softtwin.registration.cloud import Cloud, turned
from softtwin.registration.contact import ContactRegistrar
from softtwin.registration.forward import ForwardModel, State
from softtwin.registration.hybrid import HybridRegistrar
from softtwin.registration.lbfgs import LBFGS
from softtwin.registration.options import (
    RegistrationOptions,
    expected_force,
    expected_pressure,
    noise_prior,
    options_for,
)
from softtwin.registration.parameters.inputs import InputBlocks
from softtwin.registration.parameters.pose import PosePrior
from softtwin.registration.penalties import PENALTIES
from softtwin.registration.pose import Pose
from softtwin.registration.registrar import Registrar, prepare
from softtwin.registration.residuals.landmarks import LandmarkPairs
from softtwin.registration.residuals.term import ResidualTerm
from softtwin.registration.result import Registration
from softtwin.registration.rigid import align
from softtwin.registration.strategies.resuming import Found
from softtwin.registration.surface_distance import SurfaceDistance
from softtwin.registration.tracker import Tracker
from softtwin.registration.verdict import Judgement, Verdict

from .config import Config, ConfigError, RegistrationSection, files_axes, parse_config
from .inputs import check_material, load_plan
from .parameters import ParameterError
from .scenario import Scenario
from .workspace import open_workspace

if TYPE_CHECKING:
    from softtwin.reference.data.materials import Material
    from softtwin.reference.data.springs import Support
    from softtwin.reference.unloaded import Unloaded
    from softtwin.surrogate.equilibria_model import EquilibriaModel
    from softtwin.surrogate.error_bound import ErrorBound, ErrorEstimator
    from softtwin.surrogate.loaded import LoadedSurrogate
    from softtwin.surrogate.model import Surrogate, SurrogateState

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Engine = Registrar | HybridRegistrar | ContactRegistrar
MODEL_ERROR = "model_error.npz"  # in a twin: covariance of its model-error ensemble
# Of a pose of which nothing is believed: radians, body sizes. With two thirds or twice as much margins change by 2 %.
_OPEN_ROTATION, _OPEN_TRANSLATION = float(np.deg2rad(30.0)), 0.2
_TOLERANCE, _ITERATIONS = 1e-5, 15  # of Newton's method in registration, relative to the load
FORMER_MODEL_ERROR = "doubt.npz"  # the name of that file before
Camera = Pose | PosePrior | Literal["align"] | None
"""Where the camera stands: a known pose, one that is an unknown near an expected one, `align` for an unknown one that
is first looked for in the clouds themselves, None for clouds in the coordinates of the body at rest, as well as the
configuration's `known_rotation` and `known_translation` say."""


Landmarks = tuple[ArrayLike, ArrayLike]
"""Points on the observed side at rest, and where the same points were found, (l, 3) each, metres."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One cloud of a sequence.

    Args:
        number: of the frame, from 0.
        judgement: whether the result can be used, and why not.
        registration: what was found; None where the cloud cannot be registered at all.
        seconds: wall time, that of a search for the pose included.
        cloud: points that were used, after thinning, (p, 3), metres; None as above.
        landmarks: how many pulled beside the cloud.
        missing: rows of the cloud that were passed over: zeros or NaN, where a camera has measured nothing.
    """

    number: int
    judgement: Judgement
    registration: Registration | None
    seconds: float
    cloud: Floats | None = None
    landmarks: int = 0
    missing: int = 0


class Twin:
    """A body with a forward model, ready to predict and to register; all lengths are metres.

    `Twin.open` reads one from a folder; with a forward model of your own, build it directly. Use it in a `with`
    statement where the model is the reference: FEniCSx' objects are given back at its end.

    Args:
        model: forward model.
        config: settings; `config.registration` says how clouds are registered.
        resources: what is given back when the twin is closed.
        fast: a faster model of the same body, which registers first (the hybrid engine); None for the model alone.
        model_error: what the model-error ensemble perturbs, as `softtwin model-error` was asked; empty without one.
    """

    def __init__(
        self,
        model: ForwardModel,
        config: Config | None = None,
        resources: ExitStack | None = None,
        fast: ForwardModel | None = None,
        model_error: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.model_error = model_error
        self._model: ForwardModel | None = model
        self._fast = fast
        self._body = model.body
        self.config = config or Config()
        self._resources = resources or ExitStack()
        self._registrars: dict[str, Engine] = {}
        self._posed: tuple[str, PosePrior, Engine] | None = None

    @classmethod
    def open(cls, folder: Path | str, model: str = "", **options: Any) -> Twin:
        """The twin of a folder.

        Args:
            folder: a twin; a folder with a body and its configuration, without a network; or a configuration file.
            model: `surrogate`, `reference`, `hybrid` or `torch`; what the twin's configuration says if not given.
            options: entries of the configuration's [registration] that replace what it says (`noise=1e-3`, ...).

        Raises:
            ConfigError: the folder is no twin, has no surrogate, or an option cannot be.
            TwinError: the surrogate is damaged, or of another body.
        """
        return find_twin(folder).twin(model, **options)

    def close(self) -> None:
        """Give back what the model holds; the twin is of no use afterwards, nor are derivatives of its states."""
        self._model = self._fast = None  # FEniCSx ends the process that uses what was given back
        self._registrars.clear()
        self._posed = None
        self._resources.close()

    def __enter__(self) -> Twin:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def model(self) -> ForwardModel:
        """The forward model.

        Raises:
            RuntimeError: the twin has been closed.
        """
        if self._model is None:
            raise RuntimeError("twin: expected an open twin, got one that was closed; open it again.")
        return self._model

    @property
    def body(self) -> Body:
        """The body at rest, metres."""
        return self._body

    @property
    def coordinates(self) -> Coordinates:
        """Unit and axes of the files that the body was made from."""
        return coordinates_of(self.config)

    @property
    def written_in(self) -> Coordinates:
        """Unit and axes of what is written of its registrations; figures are in metres, on the same axes."""
        section, own = self.config.registration, self.coordinates
        unit = own.unit if section.output_unit == "source" else section.output_unit
        return Coordinates(unit, own.axes if section.output_frame == "source" else section.output_frame)

    def predict(self, forces: ArrayLike) -> State:
        """The state under nodal forces: `displacement`, (n, 3), metres, and its derivatives.

        Args:
            forces: (n, 3), newtons, in the body's node order.
        """
        return self.model.solve(forces)

    def bound_error(self, forces: ArrayLike, state: SurrogateState | None = None, newton: bool = False) -> ErrorBound:
        """How wrong the network's displacement under nodal forces may be, and whether that may be relied upon.

        Args:
            forces: (n, 3), newtons, in the body's node order.
            state: what `predict` found for them, if that is at hand.
            newton: read the bounds from one step of Newton's method, dearer and tighter, which also tells whether the
                predicted state is stable.

        Raises:
            CalibrationError: the model is no network, or it was never calibrated.
        """
        return self._certifier.bound_error(forces, state, newton)

    def bounded(self, found: Registration) -> ErrorBound | None:
        """How wrong the network may be about a registered state; None where there is none that was calibrated.

        Of the hybrid engine it is about what the network had found.

        Args:
            found: a registration of this twin.
        """
        card: Any = getattr(self._fast or self.model, "card", {})
        if self._fast is None and found.estimates:
            return None  # bounds are of the tissue that was learned, and not of one that was estimated
        return self._certifier.bound_error((found.draft or found).forces) if card.get("certificate") else None

    @property
    def network(self) -> Surrogate:
        """The surrogate that predicts, or that registers first where the engine is hybrid.

        Raises:
            ConfigError: there is none.
        """
        from softtwin.surrogate.loaded import LoadedSurrogate  # torch is needed here alone
        from softtwin.surrogate.model import Surrogate

        model = self._fast or self.model
        found = model.surrogate if isinstance(model, LoadedSurrogate) else model
        if not isinstance(found, Surrogate):
            raise ConfigError(
                f"registration.model: expected a twin that registers with its surrogate (surrogate or hybrid), got "
                f"{self.config.registration.model}."
            )
        return found

    @property
    def known_forces(self) -> Floats | None:
        """Nodal forces that the surrogate is asked for beside all others, (n, 3), newtons; None without any."""
        known: Floats | None = getattr(self._fast or self.model, "known", None)
        return known

    def with_network(self, network: Surrogate) -> Twin:
        """The same with a surrogate that has learned more since, ready for the zones and the pose that are in use.

        It shares everything else with this twin, and is closed with it: see `adopt`.

        Args:
            network: of the same body.

        Raises:
            ConfigError: a twin without a surrogate, or one whose contact is of unknown place.
        """
        from softtwin.surrogate.loaded import LoadedSurrogate

        before, known = self.network, self.known_forces
        if network.body.fingerprint != before.body.fingerprint:
            raise ConfigError("Twin.with_network: expected a surrogate of the twin's body, got one of another.")
        new: Surrogate | LoadedSurrogate = network if known is None else LoadedSurrogate(network, known)

        def renewed(engine: Engine) -> Engine:
            if isinstance(engine, ContactRegistrar):
                raise ConfigError("Twin.with_network: expected forces in known places, got a contact of unknown place.")
            return engine.with_fast(new) if isinstance(engine, HybridRegistrar) else engine.with_model(new)

        other = copy.copy(self)
        other._model, other._fast = (new, None) if self._fast is None else (self._model, new)
        other._registrars = {zone: renewed(engine) for zone, engine in list(self._registrars.items())}
        posed = self._posed
        other._posed = None if posed is None else (posed[0], posed[1], renewed(posed[2]))
        if "_certifier" in self.__dict__ and network.card.get("certificate"):
            other._certifier = self._certifier.of(network)
        return other

    def adopt(self, other: Twin) -> None:
        """Become what `with_network` has made of this twin: for the next frame, whole or not at all.

        What was prepared for other zones or poses since is prepared anew where it is asked for.

        Args:
            other: made by this twin.
        """
        self.__dict__.update(other.__dict__)
        if "_certifier" not in other.__dict__:
            self.__dict__.pop("_certifier", None)

    def take_bounds(self, known: Mapping[str, Any]) -> None:
        """Take other bounds of the surrogate's error, such as tests of its answers have asked for.

        Args:
            known: as `bounds`.
        """
        self._certifier = self._certifier.with_known(known)

    @cached_property
    def _certifier(self) -> ErrorEstimator:
        from softtwin.surrogate.error_bound import ErrorEstimator  # torch is needed here alone
        from softtwin.surrogate.error_indicators import CalibrationError
        from softtwin.surrogate.model import Surrogate

        network = self._fast or self.model
        if not isinstance(network, Surrogate):
            raise CalibrationError(f"Twin.bound_error: expected a twin with a network, got {type(network).__name__}.")
        return ErrorEstimator(network)

    @property
    def bounds(self) -> dict[str, Any] | None:
        """What bounds of the surrogate's error are made of, now; None where it has none, or known loads act beside."""
        model: Any = self._fast or self.model
        return self._certifier.known if getattr(model, "card", {}).get("certificate") else None

    def register(
        self,
        cloud: ArrayLike,
        zone: str | None = None,
        start: Registration | None = None,
        camera: Camera = None,
        *,
        landmarks: Landmarks | None = None,
        landmark_deviation: float | None = None,
        terms: tuple[ResidualTerm, ...] = (),
    ) -> Registration:
        """The forces and the state that explain a cloud, with a verdict on them.

        Args:
            cloud: observed points, (p, 3), metres; with normals measured there behind them (p, 6): they pull, too.
            zone: node set whose nodes may carry force; empty for all loaded nodes; what the configuration says if not
                given.
            start: result of an earlier frame to start from; no force if not given.
            camera: where the camera stands.
            landmarks: points on the observed side at rest, and where the same points were found, in the cloud's
                coordinates, (l, 3) each, metres: they pull beside the cloud.
            landmark_deviation: standard deviation of each coordinate of where they were found, metres; what the
                configuration says if not given.
            terms: other measurements that pull beside the cloud, in the coordinates that it is brought to.

        Raises:
            ConfigError: no such zone; landmarks beside a contact of unknown place.
            CloudError: a cloud without one point of finite coordinates, one that lies too far from the body, or one
                that shows no one pose.
            NotConverged: the model found no state at the start.
            ValueError: landmarks that do not lie on the observed side, or of other shapes.
        """
        if camera == "align":
            camera = self.aligned(cloud)
        camera = camera or self.as_said

        def run(registrar: Engine, points: Floats) -> Registration:
            return self._measured(registrar, landmarks, landmark_deviation, camera, terms).register(points, start)

        return self._posed_result(cloud, zone, camera, run)

    def ways(
        self,
        zone: str | None,
        camera: Camera,
        until: float = np.inf,
        landmarks: Landmarks | None = None,
        terms: tuple[ResidualTerm, ...] = (),
    ) -> TwinWays:
        """How the next cloud of a sequence can be registered.

        Args:
            zone: as for `register`.
            camera: where the camera stands.
            until: no step is begun after this time of the monotonic clock, seconds; a search beside the frames has no
                such limit.
            landmarks: as for `register`.
            terms: as for `register`.
        """
        return TwinWays(self, zone, camera or self.as_said, until, landmarks, terms)

    def _measured(
        self,
        registrar: Engine,
        landmarks: Landmarks | None,
        deviation: float | None,
        camera: Camera,
        terms: tuple[ResidualTerm, ...] = (),
    ) -> Engine:
        """What registers with landmarks and other terms beside the cloud; as it is where there are none."""
        if landmarks is None:
            return _takes_marks(registrar).with_terms(*terms) if terms else registrar
        registrar = _takes_marks(registrar)
        places = np.asarray(landmarks[1], dtype=np.float64)
        if isinstance(camera, Pose) and places.ndim == 2 and places.shape[1] == 3:
            places = camera.inverse().apply(places)
        wide = self.config.registration.landmark_deviation if deviation is None else deviation
        marks = LandmarkPairs.of(registrar.observed, landmarks[0], places, wide)
        return registrar.with_terms(marks, *terms)

    @property
    def observed(self) -> SurfaceDistance:
        """The side that a camera sees, on which landmarks lie.

        Raises:
            ConfigError: a contact of unknown place is asked for, which takes no landmarks.
        """
        return _takes_marks(self.registrar()).observed

    def _posed_result(
        self, cloud: ArrayLike, zone: str | None, camera: Camera, run: Callable[[Engine, Floats], Registration]
    ) -> Registration:
        points = Cloud.of(cloud).array()  # rows of zeros are none before they are turned
        if isinstance(camera, Pose):
            back = camera.inverse()
            return run(self.registrar(zone), turned(points, back.rotation, back.translation)).seen_from(camera)
        assert camera != "align"
        return run(self.registrar(zone, camera), points)

    def stream(
        self,
        clouds: Iterable[ArrayLike],
        zone: str | None = None,
        camera: Camera = None,
        *,
        terms: tuple[ResidualTerm, ...] = (),
    ) -> Iterator[Frame]:
        """Clouds registered in their order as they come, each from the last result that was not refused.

        A cloud that cannot be registered gives a refused frame with the reason, and the stream goes on.

        Args:
            clouds: one cloud a frame, (p, 3), metres.
            zone: as for `register`.
            camera: where the camera stands, for all clouds; `align` looks for it in the first that shows it.
            terms: as for `register`, for all clouds.

        Raises:
            ConfigError: no such zone.
        """
        sequence = Sequence(self, zone, camera)
        for cloud in clouds:
            yield sequence.register(cloud, terms=terms)

    def targets(self, result: Registration) -> dict[str, Floats]:
        """Where the vertices of each inner surface are after a registration, (p, 3), metres, by name.

        In the coordinates of the body at rest; `result.pose.apply` takes them to the camera's.
        """
        return {name: surface.points for name, surface in self._inner(result).items()}

    @property
    def organ(self) -> str:
        """Name of the organ's own surface among those of the structures."""
        return "organ" if "organ" not in self.body.inner else "organ surface"

    def surfaces(self, result: Registration) -> dict[str, Surface]:
        """The moved surface of each structure, metres, by name: the organ's first, then the inner ones."""
        return {self.organ: outer(self.body).moved(result.displacement), **self._inner(result)}

    def _inner(self, result: Registration) -> dict[str, Surface]:
        return {
            name: Surface(surface.points + self.embeddings[name].displace(result.displacement), surface.triangles)
            for name, surface in self.body.inner.items()
        }

    @cached_property
    def embeddings(self) -> dict[str, Embedding]:
        """How the body carries the vertices of each inner surface, by name."""
        return target_points(self.body)

    @cached_property
    def outside(self) -> dict[str, NDArray[np.bool_]]:
        """Which vertices of each inner surface lie outside the organ, and are carried along, by name."""
        return {name: is_carried_along(self.body, points) for name, points in self.embeddings.items()}

    def margin_inside(self, name: str, margins: NDArray[np.float64]) -> float:
        """The largest margin of what lies inside the organ of an inner surface, metres: of the rest nothing is known.

        Args:
            name: of the surface.
            margins: of its vertices, (v,), metres.
        """
        inside = margins[~self.outside[name]]
        return float(inside.max()) if len(inside) else np.inf

    def aligned(self, cloud: ArrayLike) -> PosePrior:
        """An unknown pose about the one that a cloud alone shows.

        Args:
            cloud: (p, 3), metres.

        Raises:
            CloudError: no pose explains the cloud, or more than one does.
        """
        found = align(Surface(outer(self.body).rest.points, self._seen), Cloud.of(cloud).points)
        if not found.is_found:
            raise CloudError(f"cloud: the pose was not found ({found.outcome.value}). {found.outcome.advice}")
        return self.fitted_prior(found.pose)

    @property
    def _seen(self) -> Ints:
        """The side that a camera sees, (t, 3)."""
        return self.body.surfaces.get("observed", outer(self.body).rest.triangles)

    def near(self, pose: Pose) -> PosePrior:
        """An unknown pose about an expected one, with the deviations of the configuration."""
        options = self.config.registration
        return PosePrior(pose, self._middle, np.deg2rad(options.pose_rotation), options.pose_translation)

    def fitted_prior(self, pose: Pose) -> PosePrior:
        """An unknown pose about one that was fitted to the moved organ itself: to its cloud, or to landmarks on it.

        Such a pose follows the organ's own movement as far as it can. Believed beforehand to be near the true one, it
        would count what the camera sees twice, and forces would be found too small. It is a place to begin; what is
        believed of the pose is as good as nothing.
        """
        return PosePrior(pose, self._middle, _OPEN_ROTATION, _OPEN_TRANSLATION * self.body.size)

    @cached_property
    def as_said(self) -> PosePrior | None:
        """What the configuration believes of a pose that nobody gives; None where it is exactly the body's.

        Under known forces it is: what the pose is off by would be taken for stiffness.
        """
        options = self.config.registration
        if options.pose == "unknown":
            return self.near(Pose.identity())
        rotation, translation = np.deg2rad(options.known_rotation), options.known_translation
        if options.pose == "fixed" or options.forces == "known" or 0.0 in (rotation, translation):
            return None
        return PosePrior(Pose.identity(), self._middle, rotation, translation, is_said=True)

    @property
    def _middle(self) -> Floats:
        """Of what a camera sees, (3,), metres."""
        middle: Floats = outer(self.body).rest.points[np.unique(self._seen)].mean(axis=0)
        return middle

    def registrar(self, zone: str | None = None, camera: PosePrior | None = None) -> Engine:
        """What registers clouds with forces in a zone; prepared once (about a second), then kept.

        Args:
            zone: as for `register`.
            camera: prior of an unknown pose; None for clouds in the body's coordinates.

        Raises:
            ConfigError: no such zone.
        """
        zone = self.config.registration.zone if zone is None else zone
        if camera is not None:
            posed = self._posed  # once: a search beside the frames may put another there
            if posed is None or posed[0] != zone or posed[1] is not camera:
                self._posed = posed = zone, camera, self._prepared(zone, camera)
            return posed[2]
        if zone not in self._registrars:
            self._registrars[zone] = self._prepared(zone, None)
        return self._registrars[zone]

    def _prepared(self, zone: str, camera: PosePrior | None) -> Engine:
        if camera is not None:
            plain = self.registrar(zone)
            if isinstance(plain, HybridRegistrar):
                return HybridRegistrar(plain.fast.with_pose(camera), plain.exact.with_pose(camera))
            if isinstance(plain, ContactRegistrar):
                return ContactRegistrar(plain.anywhere.with_pose(camera), plain.patch)
            return plain.with_pose(camera)
        patch = Scenario.of(self.config).patch
        exact = self._alone(self.model, zone)
        if patch is not None:
            return ContactRegistrar(exact, patch)
        return exact if self._fast is None else HybridRegistrar(self._alone(self._fast, zone), exact)

    def _inputs(self, model: ForwardModel) -> InputBlocks | None:
        """Unknown inputs beside the forces, for the model that takes them."""
        if model is self._fast:
            return None
        material = self.config.material
        try:
            return Scenario.of(self.config).inputs(
                self.body, material.young_modulus, material.poisson_ratio, self.coordinates
            )
        except ValueError as error:
            raise ConfigError(f"registration.parameters: {error}") from None

    def _alone(self, model: ForwardModel, zone: str) -> Registrar:
        body, section = self.body, self.config.registration
        if zone and zone not in body.node_sets:
            raise ConfigError(f"registration.zone: expected one of {sorted(body.node_sets)}, got {zone!r}.")
        loaded = loaded_nodes(body, load_plan(self.config))
        nodes = None if section.forces == "known" else body.node_sets[zone] if zone else loaded
        expected = expected_pressure if section.forces == "normal" else expected_force
        inputs = self._inputs(model)
        if nodes is not None and inputs is not None and not len(np.setdiff1d(nodes, inputs.moved_nodes)):
            raise ConfigError(
                f"registration.zone: expected nodes that may carry force, got {zone or 'loaded nodes'}, all of which "
                "moved@ holds; what is moved carries none. Give another zone."
            )
        return prepare(
            model,
            nodes,
            body.surfaces.get("observed"),
            force_scale=section.force_scale or expected(body, self.config.material.young_modulus),
            smoothness=section.smoothness,
            directions=section.directions,
            options=_options(section, options_for(model, bool(zone) or section.forces == "normal")),
            inputs=inputs,
            blocks=Scenario.of(self.config).blocks,
            modulus_deviation=self.config.material.young_modulus_deviation,
            elsewhere=loaded if zone else None,
            along_normals=section.forces == "normal",
        )


@dataclass(frozen=True, eq=False)
class TwinWays:
    """A cloud from rest or from the last frame, as `Tracker` asks for it; the arguments are those of `Twin.ways`.

    Beside the frames `search` is asked for what has to be found from rest, where it is there and no landmarks pull.
    """

    twin: Twin
    zone: str | None
    camera: Camera
    until: float
    landmarks: Landmarks | None
    terms: tuple[ResidualTerm, ...] = ()
    search: Searches | None = None
    before_step: Callable[[], None] | None = None

    def beside(self, before_step: Callable[[], None]) -> TwinWays:
        """The same for a thread beside the frames: see `Registrar.beside`."""
        return replace(self, before_step=before_step)

    def track(self, cloud: ArrayLike, last: Registration) -> Registration:
        """From the last state alone: see `Registrar.track`."""
        return self._run(cloud, lambda engine, points: _registrar(engine).track(points, last))

    def follow(self, cloud: ArrayLike, last: Registration | None) -> Registration:
        """From the last state, and from rest where that is not accepted: see `Registrar.follow`."""
        if last is None and self.search is not None and self.before_step is not None and self._is_plain:
            with suppress(SearchEnded):  # then it is searched for here
                found = self.search.found(cloud, self.zone, self.camera, self.before_step)
                if found is None:
                    raise NotConverged("the search from rest has found no state of use")
                return self._run(cloud, lambda engine, points: _registrar(engine).resumed(points, found))
        return self._run(cloud, lambda engine, points: engine.follow(points, last))

    @property
    def _is_plain(self) -> bool:
        """Whether clouds are all that pulls."""
        return self.landmarks is None and not self.terms

    def is_lost(self, found: Registration, last: Registration) -> bool:
        """Whether what was tracked has to be searched for from rest: see `Registrar.is_lost`."""
        camera = self.camera if isinstance(self.camera, PosePrior) else None
        return _registrar(self.twin.registrar(self.zone, camera)).is_lost(found, last)

    def is_missed(self, found: Registration) -> bool:
        """Whether it has to be asked if forces outside the zone explain what is left: see `Registrar.is_missed`."""
        camera = self.camera if isinstance(self.camera, PosePrior) else None
        return _registrar(self.twin.registrar(self.zone, camera)).is_missed(found)

    def asked(self, cloud: ArrayLike, found: Registration) -> Registration:
        """The result with the answer to that: see `Registrar.asked`."""
        return self._run(cloud, lambda engine, points: _registrar(engine).asked(points, found))

    def _run(self, cloud: ArrayLike, follow: Callable[[Engine, Floats], Registration]) -> Registration:
        def run(registrar: Engine, points: Floats) -> Registration:
            limited = registrar.limited(self.until) if self.until < np.inf else registrar
            if self.before_step is not None:
                limited = _registrar(registrar).beside(self.before_step)
            return follow(self.twin._measured(limited, self.landmarks, None, self.camera, self.terms), points)

        return self.twin._posed_result(cloud, self.zone, self.camera, run)


def _registrar(engine: Engine) -> Registrar:
    assert isinstance(engine, Registrar)  # others are not concurrent, and are not tracked alone
    return engine


class Learner(Protocol):
    """What learns while frames come: see `softtwin.app.learning.BackgroundLearner`."""

    def renew(self) -> None:
        """Before a frame: give the twin what was learned since the last one."""

    def tell(self, frame: Frame) -> None:
        """After a frame: what was found."""


class SearchEnded(RuntimeError):  # noqa: N818 - a way to end
    """Who searches from rest has ended."""


class Searches(Protocol):
    """Who searches from rest elsewhere: see `softtwin.app.searching.SearchProcess`."""

    @property
    def is_ready(self) -> bool:
        """Whether it can be asked."""

    def found(self, cloud: ArrayLike, zone: str | None, camera: Camera, wait: Callable[[], None]) -> Found | None:
        """What it finds for a cloud; None where that is of no use."""


class Sequence:
    """Frames of one twin, each registered from what the last usable one found.

    Args:
        twin: the twin.
        zone: as for `Twin.register`.
        camera: where the camera stands.
        is_live: no answer waits for a search from rest, which a twin whose model is a network does beside the frames;
            what is found when depends on time then.
        learner: is told of each frame, and may renew the twin between two of them; none if not given.
        search: searches from rest in place of a thread beside the frames; none if not given.
    """

    def __init__(
        self,
        twin: Twin,
        zone: str | None = None,
        camera: Camera = None,
        *,
        is_live: bool = False,
        learner: Learner | None = None,
        search: Searches | None = None,
    ) -> None:
        self.twin, self.zone, self.camera, self._learner, self._search = twin, zone, camera, learner, search
        self._count = 0
        engine = twin.registrar(zone)  # a zone that is not there is said before the first cloud
        is_concurrent = isinstance(engine, Registrar) and bool(getattr(engine.model, "is_concurrent", False))
        self._tracker, self._is_live = Tracker(background=is_live and is_concurrent), is_live
        if is_live:  # a collection over all that a twin has loaded takes 0.2 s, which one answer would wait for
            gc.collect()
            gc.freeze()

    def close(self) -> None:
        """End: what is still searched for beside the frames is forgotten."""
        self._tracker.close()
        if self._is_live:
            gc.unfreeze()

    def register(
        self,
        cloud: ArrayLike,
        until: float = np.inf,
        landmarks: Landmarks | None = None,
        terms: tuple[ResidualTerm, ...] = (),
    ) -> Frame:
        """The next frame; refused, with the reason, where the cloud cannot be registered.

        Args:
            cloud: (p, 3), metres.
            until: no step is begun after this time of the monotonic clock, seconds: the result is the best so far.
            landmarks: as for `Twin.register`.
            terms: as for `Twin.register`.

        Raises:
            ConfigError, ValueError: landmarks or terms that the twin cannot take.
        """
        begin = time.perf_counter()
        if self._learner is not None:
            self._learner.renew()
        try:
            given = self._thinned(cloud)
            points = given.array()
            if self.camera == "align":
                self.camera = self.twin.aligned(points)
            ways = self.twin.ways(self.zone, self.camera, until, landmarks, terms)
            if self._search is not None and self._search.is_ready:
                ways = replace(ways, search=self._search)
            result = self._tracker.take(points, ways)
        except (CloudError, NotConverged) as error:
            return self.refuse(str(error), time.perf_counter() - begin)
        count = 0 if landmarks is None else len(np.asarray(landmarks[0]))
        seconds = time.perf_counter() - begin
        frame = Frame(self._next(), result.judgement, result, seconds, points[:, :3], count, given.missing)
        if self._learner is not None:
            self._learner.tell(frame)
        return frame

    def _thinned(self, cloud: ArrayLike) -> Cloud:
        """Once for all that is tried with it; what is no cloud is left for the registrar to refuse."""
        given = Cloud.of(cloud)
        return given.thinned(self.twin.config.registration.points) if given.is_finite else given

    def refuse(self, reason: str, seconds: float = 0.0) -> Frame:
        """The next frame without a result: its cloud cannot be used.

        Args:
            reason: why.
            seconds: wall time spent on it.
        """
        return Frame(self._next(), Judgement(Verdict.REFUSED, (reason,)), None, seconds)

    def _next(self) -> int:
        self._count += 1
        return self._count - 1


def _takes_marks(registrar: Engine) -> Registrar | HybridRegistrar:
    if isinstance(registrar, ContactRegistrar):
        raise ConfigError("landmarks: expected none beside a contact of unknown place, got some.")
    return registrar


def _options(section: RegistrationSection, suited: RegistrationOptions) -> RegistrationOptions:
    usual = noise_prior(section.noise)
    spread = 0.0 if section.noise_known else usual.spread
    noise = replace(usual, spread=spread, minimum=min(usual.minimum, section.noise))
    solver = suited.solver
    if section.penalty != "prior":
        solver = LBFGS(penalty=PENALTIES[section.penalty](section.alpha))
    elif section.solver == "l-bfgs":
        solver = LBFGS()
    if section.max_iterations:
        solver = replace(solver, max_iterations=section.max_iterations)
    localisation = suited.localisation
    if section.reweighting_rounds >= 0:
        localisation = replace(localisation, rounds=section.reweighting_rounds)
    return replace(
        suited,
        noise=noise,
        solver=solver,
        maximum_points=section.points,
        localisation=localisation,
        distance=section.distance,
        normal_deviation=float(np.deg2rad(section.normal_deviation)),
    )


def with_options(config: Config, options: dict[str, Any]) -> Config:
    """The configuration with other entries in its [registration].

    Raises:
        ConfigError: an entry is unknown or out of range.
    """
    entries = config.model_dump()
    entries["registration"] |= options
    return parse_config(entries, "registration")


def coordinates_of(config: Config) -> Coordinates:
    """Unit and axes of the files that a body was made from."""
    return Coordinates(config.body.unit, files_axes(config.body) or "lps")


@dataclass(frozen=True, eq=False)
class Home:
    """What was found where a twin was looked for.

    Args:
        folder: that holds the surrogate, if there is one.
        body: the body.
        config: the configuration.
    """

    folder: Path
    body: Body
    config: Config

    def twin(self, model: str = "", **options: Any) -> Twin:
        """The twin that is here; see `Twin.open`."""
        config = with_options(self.config, {**options, **({"model": model} if model else {})})
        with ExitStack() as opened:
            both = opened.enter_context(forward_models(config.registration.model, self.folder, self.body, config))
            known = known_model_error(self.folder, self.body, config)
            return Twin(both[0], config, opened.pop_all(), both[1], {} if known is None else known[1])


def find_twin(place: Path | str) -> Home:
    """The body, the configuration and the folder of a twin.

    Args:
        place: a twin's folder, the folder that its stages were run in, or the configuration file of that.

    Raises:
        ConfigError: the place is none of them, or its material is not the one that its surrogate has learned.
    """
    place = Path(place)
    if place.is_file():
        space = open_workspace(place)
        file, config, folder = space.body, space.config, space.twin
    else:
        inner = place / "twin"
        folder = inner if (inner / "organ.toml").is_file() and not (place / "surrogate.json").is_file() else place
        missing = [name for name in ("body.vtu", "organ.toml") if not (folder / name).is_file()]
        if missing:
            raise ConfigError(
                f"twin: expected a twin folder with {' and '.join(missing)} in {place}; make one with `softtwin build`."
            )
        file, config = folder / "body.vtu", open_workspace(folder / "organ.toml").config
    if not file.is_file():
        raise ConfigError(f"twin: expected the body in {file}, found none; run `softtwin mesh {place}` first.")
    check_material(folder, config)
    return Home(folder, read_body(file), config)


@contextmanager
def forward_models(
    name: str, folder: Path, body: Body, config: Config
) -> Iterator[tuple[ForwardModel, ForwardModel | None]]:
    """The forward model that registers, and a faster one that registers first where the engine is hybrid.

    Args:
        name: `surrogate`, `reference` (where FEniCSx is installed), `hybrid` or `torch`.
        folder: the twin.
        body: its body.
        config: its configuration; gives the reference its material.

    Raises:
        ConfigError: there is no surrogate.
        ValueError: a surrogate of another material than the configuration's.
    """
    network, known = None, known_model_error(folder, body, config)
    further = None if known is None else known[0]
    if name in ("surrogate", "hybrid"):
        if not (folder / "surrogate.json").is_file():
            raise ConfigError(
                f"twin: expected a surrogate in {folder}, found no surrogate.json; train one with `softtwin build`, "
                "or register with the body alone by equilibria (--model reference, which needs FEniCSx, or --model "
                "torch)."
            )
        from softtwin.surrogate.twin import load  # torch is needed here alone

        network = load(folder, body)
        if further is not None:
            from softtwin.surrogate.discrepancy import beside

            network = beside(network, further)
    if name == "surrogate":
        assert network is not None
        yield network, None
        return
    from softtwin.reference.data.materials import MATERIALS

    scenario = Scenario.of(config)
    held = scenario.held(body)
    strange = sorted(held.keys() - body.node_sets.keys())
    if strange:
        raise ConfigError(
            f"registration.parameters: expected moved@ one of {sorted(body.node_sets)}, got {strange[0]!r}."
        )
    try:
        loading = scenario.loading(body, coordinates_of(config))
    except ParameterError as error:
        raise ConfigError(f"registration.known_forces: {error}") from None
    fast: Surrogate | LoadedSurrogate | None = network
    if network is not None and loading.forces is not None:
        fast = _loaded(network, loading.forces)
    modulus = scenario.modulus(config.material.young_modulus, body)
    material = MATERIALS[config.material.law](modulus, config.material.poisson_ratio)
    if name == "torch":
        yield _solved_in_torch(body, material, scenario.springs, loading.forces, further), None
        return
    from softtwin.reference.derivatives.model import ReferenceModel  # FEniCSx is needed here alone
    from softtwin.reference.derivatives.scanned import ScannedModel
    from softtwin.reference.solve.problem import NewtonOptions, Problem

    options = NewtonOptions(tolerance=_TOLERANCE, max_iterations=_ITERATIONS)
    behind = _unloaded(scenario, body, material, coordinates_of(config)) if any(scenario.scan_gravity) else None
    with Problem(behind.body if behind else body, material, options, held=held, springs=scenario.springs) as problem:
        model = ReferenceModel(problem, patient=False, loading=loading, predictor=fast, discrepancy=further)
        yield ScannedModel(body, model, behind.displacement) if behind else model, fast


def _unloaded(scenario: Scenario, body: Body, material: Material, coordinates: Coordinates) -> Unloaded:
    """The stress-free body behind the scanned one.

    Raises:
        ConfigError: there is none, or it would not hang as the scan shows it.
    """
    from softtwin.reference.unloaded import unloaded  # FEniCSx is needed here alone

    load = scenario.loading_of_scan(coordinates)
    try:
        found = unloaded(body, material, load, held=scenario.held(body), springs=scenario.springs)
    except NotConverged as error:
        raise ConfigError(f"registration.scan_gravity: {error}") from None
    if not found.is_stable:
        raise ConfigError(
            "registration.scan_gravity: expected an organ that hangs as the files show it, found a stress-free shape "
            f"that gives way ({found.negative_pivots} negative pivots); is the material too soft, the support too "
            "small, or the direction the opposite one?"
        )
    return found


def _solved_in_torch(
    body: Body,
    material: Material,
    springs: Mapping[str, Support],
    known: ArrayLike | None,
    further: Discrepancy | None,
) -> EquilibriaModel:
    """Equilibria in torch, in double precision on the processor."""
    from softtwin.surrogate.equilibria import Equilibria, NewtonSettings  # torch is needed here alone
    from softtwin.surrogate.equilibria_model import EquilibriaModel

    settings = NewtonSettings(tolerance=_TOLERANCE, iterations=_ITERATIONS)
    solver = Equilibria(body, material, settings=settings, springs=springs)
    return EquilibriaModel(solver, known, discrepancy=further, patient=False)


def _loaded(network: Surrogate, known: ArrayLike) -> LoadedSurrogate:
    """The network under known forces; a ConfigError where it has never seen any."""
    from softtwin.surrogate.loaded import LoadedSurrogate  # torch is needed here alone

    try:
        return LoadedSurrogate(network, known)
    except ValueError as error:
        raise ConfigError(f"registration.known_forces: {error} Register with the reference engine.") from None


def known_model_error(folder: Path, body: Body, config: Config) -> tuple[Discrepancy, dict[str, Any]] | None:
    """What `softtwin model-error` found for a twin, and what it was asked; None where it has not run.

    Raises:
        ConfigError: it was found for another law of material.
        DiscrepancyError: the file cannot be used.
    """
    file = next((folder / name for name in (MODEL_ERROR, FORMER_MODEL_ERROR) if (folder / name).is_file()), folder)
    if not file.is_file():
        return None
    found, made_of = read_discrepancy(file, body)
    if made_of.get("material") != config.material.law:
        raise ConfigError(
            f"{file}: made for the material {made_of.get('material')!r}, and material.law is {config.material.law!r}; "
            "make it again with `softtwin model-error`."
        )
    return found, made_of
