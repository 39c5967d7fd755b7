"""`softtwin live`: a twin before a real camera; clouds come from a folder, a Python iterator, or OpenIGTLink."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing
from pathlib import Path
from typing import Any

from softtwin.meshes.io import Axes, Unit

from ..address import Address
from ..config import ConfigError
from ..live import check_keep, check_learning, learning
from ..record import NOTICE
from ..register import Scene, Start
from ..sources import check_idle, watched
from ..streams import Cloud, Mailbox
from ..twin import Camera, Home, Learner, Twin, find_twin
from .camera import Shot
from .demo import run_until_interrupted
from .server import address, open_browser, serving
from .session import Learning, Session

Say = Callable[[str], None]


def clouds_of(source: Path | Address, scene: Scene, idle: float | None = None, say: Say = print) -> Iterable[Cloud]:
    """Clouds of a source that a person has named, at their own pace.

    Args:
        source: of `parse_source`: a folder that clouds are written into, or a place of OpenIGTLink.
        scene: the twin with the coordinates of the clouds.
        idle: seconds without anything new after which the source ends; never if not given.
        say: prints a line.

    Raises:
        ConfigError: no such folder, a time that is none, or normals of a peer that sends none.
    """
    check_idle(idle)
    if isinstance(source, Address):
        if scene.normals:
            raise ConfigError(f"--normals: expected files that hold some, got {source}: its clouds are points alone.")
        return _heard(source, scene, idle, say)
    if not source.is_dir():
        raise ConfigError(f"SOURCE: expected a folder that clouds are written into, or igtl://..., got {source}.")
    return watched(source, scene, idle, say)


def _heard(address: Address, scene: Scene, idle: float | None, say: Say) -> Iterator[Cloud]:
    """What a peer sends, the newest alone; nothing is sent back."""
    from ..openigtlink import Link  # pyigtl is needed here alone

    box = Mailbox()
    with Link(address, box, scene.outside, idle=idle, say=say):
        while (arrival := box.take()) is not None:
            yield arrival.cloud


def run_live(
    place: Path,
    source: Path | Address,
    options: Mapping[str, Any],
    *,
    unit: Unit | None = None,
    axes: Axes | None = None,
    start: Start | None = None,
    idle: float | None = None,
    learn: bool = False,
    keep: bool = False,
    port: int | None = None,
    browser: bool = True,
    say: Say = print,
) -> None:
    """Show what is registered, until Ctrl-C or the source's end.

    Args:
        place: the twin; see `find_twin`.
        source: see `clouds_of`.
        options: entries of [registration] that replace the twin's.
        unit: of the clouds; if not given that of the twin's files, millimetres for a peer.
        axes: of the clouds; if not given those of the twin's files, RAS for a peer.
        start: where the camera stands; in the body's coordinates if not given.
        idle: see `clouds_of`.
        learn: adapt the surrogate in a second process while frames come.
        keep: put what was learned into the twin at the end, and where the page changes to another engine.
        port: of the page; the first free one from 8080 on if not given.
        browser: open the page in a browser where there is a display.
        say: prints a line.

    Raises:
        ConfigError, FileError, PoseError, TwinError, LinkError: what cannot be used, and why.
    """
    check_keep(learn, keep)
    if isinstance(source, Address):
        unit, axes = unit or "mm", axes or "ras"
    scene = Scene.of(place, options, unit, axes)
    clouds = clouds_of(source, scene, idle, say)
    with scene.opened(start or Start(), say) as (twin, camera):
        if learn:
            check_learning(twin)

    def learner_of(twin: Twin) -> AbstractContextManager[Learner | None]:
        return learning(twin, learn, scene.home.folder if keep else None, say)

    _show(scene.home, clouds, options, camera, port, browser, say, learner_of if learn else None)


def show(
    twin: Path | str,
    clouds: Iterable[Cloud],
    camera: Camera = None,
    port: int | None = None,
    browser: bool = True,
    say: Say = print,
    **options: Any,
) -> None:
    """A page for clouds of your own program, until they end or Ctrl-C.

    Args:
        twin: its folder.
        clouds: points (p, 3) in metres, at their own pace; they are asked for in a thread of their own.
        camera: where the camera stands.
        port: of the page; the first free one from 8080 on if not given.
        browser: open the page in a browser where there is a display.
        say: prints a line.
        options: entries of [registration] that replace the twin's.

    Raises:
        ConfigError: the folder is no twin, an option cannot be, or the port is taken.
    """
    _show(find_twin(twin), clouds, options, camera, port, browser, say)


def _show(
    home: Home,
    clouds: Iterable[Cloud],
    options: Mapping[str, Any],
    camera: Camera,
    port: int | None,
    browser: bool,
    say: Say,
    learner_of: Learning | None = None,
) -> None:
    chosen = {name: value for name, value in options.items() if name != "model"}
    engine = str(options.get("model") or home.config.registration.model)
    with ExitStack() as stack:  # however early Ctrl-C comes: a thread at work when Python ends takes the process down
        server = stack.enter_context(serving(port, "softtwin live"))
        session = Session(server, home, options=chosen, camera=camera, engine=engine, learning=learner_of)
        stack.enter_context(closing(session))

        def show() -> None:
            say(f"softtwin live: {address(server)}   (Ctrl-C ends it). {NOTICE}")
            if browser:
                open_browser(server)
            session.run(Shot(cloud) for cloud in clouds)

        run_until_interrupted(show, say)
