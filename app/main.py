"""The command `cgf-viewer`: reads what it is given, opens one guarded port, and serves the page until Ctrl-C."""

import argparse
import contextlib
import os
import socket
import sys
import threading
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from app.ports import DEFAULT_PORT, listen_socket
from cgf import cli
from cgf.checks import InputError

if TYPE_CHECKING:
    import uvicorn
    from starlette.types import ASGIApp

    from app.loading import PairPaths
    from app.pair_source import PairSource
    from app.session import Session
    from cgf.types import Transform

DEFAULT_HOST = "127.0.0.1"
PATIENCE_S = 0.25
"""Left to the browser that paints; without a graphics card, a frame takes half of it."""

_DESCRIPTION = """\
Look at where two point clouds match: opens a page in the browser that shows both, computes features
on them, matches the features, and colours every match by its error.
"""
_EXAMPLES = """\
examples:
  cgf-viewer --demo
  cgf-viewer a.ply b.ply
  cgf-viewer a.ply b.ply --gt pose.txt
  cgf-viewer scene/           all pairs of the folder's gt.log, one chosen in the page
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the viewer with `arguments` (by default the process's own), and return the exit status."""
    options = build_parser().parse_args(arguments)
    command = view if options.report is None else report
    return cli.run(lambda: command(options), program="cgf-viewer", debug=options.debug)


def build_parser() -> argparse.ArgumentParser:
    """The parser of `cgf-viewer`."""
    parser = cli.Parser(
        prog="cgf-viewer",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "paths", nargs="*", type=Path, metavar="CLOUD", help="source and target cloud (PLY, PCD, XYZ, OBJ, STL, NPY, "
        "NPZ), or one folder of clouds with the poses of its pairs in gt.log",
    )  # fmt: skip
    parser.add_argument(
        "--demo", action="store_true", help="show the two fragments of a room that come with the program"
    )
    poses = parser.add_argument_group("poses (4x4 that maps the source onto the target, or a trajectory log)")
    poses.add_argument("--gt", type=Path, metavar="FILE", help="the true pose; for a folder, the name of its log")
    poses.add_argument("--estimate", type=Path, metavar="FILE", help="a pose found elsewhere, to be looked into")
    cli.add_feature_options(parser)
    cli.add_matching_options(parser)
    cli.add_loading_options(parser)
    speed = parser.add_argument_group("speed")
    speed.add_argument(
        "--max-points", type=_count, default=1_000_000, metavar="N", help="points of a cloud to draw at most, spread "
        "evenly (default: %(default)s; what is computed does not change)",
    )  # fmt: skip
    speed.add_argument(
        "--no-cache", action="store_true", help="neither read nor write what earlier runs computed (in the user's "
        "folder for caches, 1 GB at most)",
    )  # fmt: skip
    sharing = parser.add_argument_group("sharing")
    sharing.add_argument(
        "--state", metavar="STATE", help="settings of another run, in quotes, as the page's tab Share gives them"
    )
    sharing.add_argument(
        "--report", type=Path, metavar="FILE", help="write what the page shows to one HTML file, and open no page"
    )
    server = parser.add_argument_group("server")
    server.add_argument(
        "--port",
        type=int,
        metavar="N",
        help=f"port of the page (default: {DEFAULT_PORT}, or the next one that is free)",
    )
    server.add_argument(
        "--host", default=DEFAULT_HOST, help="address to listen on (default: %(default)s, this machine only)"
    )
    server.add_argument("--no-browser", action="store_true", help="do not open the page, only print its URL")
    cli.add_output_options(parser)
    return parser


def _count(text: str) -> int:
    """A number of points, as argparse wants it checked."""
    if not (text.isascii() and text.isdigit()) or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more, got {text!a}")
    return int(text)


def view(options: argparse.Namespace) -> int:
    """Open what `options` name and serve it until interrupted."""
    listening, note = listen_socket(options.host, options.port)
    with contextlib.closing(listening):
        # The server's libraries load while the clouds are read.
        warming = threading.Thread(target=_import_server, daemon=True)
        warming.start()
        session = open_session(options, patience_s=PATIENCE_S)
        if note:
            cli.note(options, note)
        _serve(session, listening, options)


def report(options: argparse.Namespace) -> int:
    """Write what the page would show to a file."""
    from app.report import write_report
    from cgf.cli.common import progress_bar
    from cgf.evaluation.matches import check_output

    check_output(options.report, (".html",))
    session = open_session(options)
    with progress_bar(options) as progress:
        if progress is not None:
            session.listen(lambda: progress(session.status.progress, session.status.text))
        session.start()
        session.wait_until_idle()
    session.close()
    failures = [message.text for message in session.snapshot().messages if message.level == "error"]
    if failures:
        raise InputError(failures[0])
    write_report(session, options.report)
    cli.note(options, f"Wrote {options.report}")
    return 0


def open_session(options: argparse.Namespace, *, patience_s: float = 0.0) -> "Session":
    """Read the first pair and check the settings against it, so that bad input is refused before anything opens.

    Args:
        options: As parsed.
        patience_s: Of the session.

    Raises:
        InputError: A file or a setting cannot be used.
    """
    from app.session import Session
    from app.settings import ViewSettings
    from app.state_text import read_state
    from cgf import pipeline

    sources = open_pairs(options)
    settings = ViewSettings.of_pair(cli.feature_settings(options))
    if options.state is not None:
        settings = settings.changed(read_state(options.state), pairs=len(sources))
    pair, wanted = sources[settings.pair].load(), settings.pair_settings()
    pipeline.resolve(wanted, *pipeline.correct(wanted, pair.source, pair.target))
    sources[settings.pair] = sources[settings.pair].holding(pair)
    disk = None if options.no_cache else pipeline.DiskCache()
    estimate = _read_estimate(options)
    return Session(
        sources, settings, given_estimate=estimate, disk=disk, max_shown=options.max_points, patience_s=patience_s
    )


def open_pairs(options: argparse.Namespace) -> "list[PairSource]":
    """What can be looked at: the demo, two files, or all pairs of a folder. The first is read already.

    Raises:
        InputError: The arguments name none of these, or a file cannot be used.
    """
    from app.loading import pair_source
    from app.pair_source import PairSource

    paths: list[Path] = options.paths
    if options.demo:
        if paths or options.gt or options.estimate:
            raise InputError("--demo must stand without clouds and poses of your own; leave one of them out")
        from cgf.datasets.demo import load_demo

        pair = load_demo()
        return [PairSource("Demo: two fragments of a room", lambda: pair, view=("--demo",))]
    if len(paths) == 1 and (paths[0].is_dir() or not paths[0].suffix):
        return _open_folder(paths[0], options)
    if len(paths) != 2:
        raise InputError(
            f"cgf-viewer must be given two clouds, a folder of pairs, or --demo, got {len(paths)} "
            f"path{'' if len(paths) == 1 else 's'}; see cgf-viewer --help"
        )
    viewpoint = None if options.viewpoint is None else tuple(options.viewpoint)
    return [pair_source(_paths(options), viewpoint=viewpoint, drop_invalid=options.drop_invalid)]


def _paths(options: argparse.Namespace) -> "PairPaths":
    from app.loading import PairPaths

    source, target = options.paths
    return PairPaths(source, target, options.gt)


def _open_folder(folder: Path, options: argparse.Namespace) -> "list[PairSource]":
    from app.pair_source import PairSource
    from cgf.datasets.folder import find_folder

    if options.estimate is not None:
        raise InputError("--estimate must come with two clouds, got a folder; name the two files")
    if options.viewpoint is not None:
        raise InputError("--viewpoint must come with two clouds, got a folder; name the two files")
    log = "gt.log" if options.gt is None else options.gt.name
    found = find_folder(folder, log=log)
    if not found:
        raise InputError(f"{folder / log} must hold at least one pair, got none; add the true poses")

    def source(index: int) -> PairSource:
        files = found[index]
        command = [str(files.source), str(files.target), "--gt", str(files.target.parent / log), *_reading(options)]
        return PairSource(
            files.name,
            lambda: files.read(drop_invalid=options.drop_invalid),
            tuple(command),
            files=(files.source, files.target),
        )

    return [source(index) for index in range(len(found))]


def _reading(options: argparse.Namespace) -> list[str]:
    arguments = [] if options.viewpoint is None else ["--viewpoint", *map(str, options.viewpoint)]
    return [*arguments, "--drop-invalid"] if options.drop_invalid else arguments


def _read_estimate(options: argparse.Namespace) -> "Transform | None":
    if options.estimate is None:
        return None
    from cgf import io

    source, target = options.paths
    return io.read_transform(options.estimate, source_name=source.name, target_name=target.name)


def _import_server() -> None:
    import fastapi  # noqa: F401 - only to have it loaded
    import uvicorn  # noqa: F401


def make_server(app: "ASGIApp", *, debug: bool) -> "uvicorn.Server":
    """A server for one local user; it ends at the first signal."""
    import uvicorn

    class Server(uvicorn.Server):
        """Does not wait for open pages, whose connections would never end by themselves."""

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            self.force_exit = True
            super().handle_exit(sig, frame)

    config = uvicorn.Config(
        app,
        log_level="debug" if debug else "critical",
        access_log=False,
        server_header=False,
        lifespan="off",
        # Compressing would take longer than sending; the size is that of viser's own server, and a little more.
        ws_per_message_deflate=False,
        ws_max_size=64 << 20,
    )
    return Server(config)


def _serve(session: "Session", listening: socket.socket, options: argparse.Namespace) -> NoReturn:
    from app.guard import Guard, new_token

    token = new_token()
    # The port listens already: a browser that comes now waits for its answer while it starts.
    _announce(listening, token, options)
    session.start()
    with contextlib.ExitStack() as running:
        running.callback(session.close)
        with contextlib.suppress(KeyboardInterrupt):
            from app.loading import Loader, Recent, recent_file
            from app.routes import create_app
            from app.viewer.live import LiveScene

            scene = LiveScene(session)
            running.callback(scene.stop)
            recent = Recent(recent_file())
            if len(options.paths) == 2:
                recent.add(_paths(options))
            loader = Loader(session, recent)
            running.callback(loader.close)
            app = Guard(create_app(session, scene, loader), token=token, hosts=[options.host, socket.gethostname()])
            make_server(app, debug=options.debug).run(sockets=[listening])
    # A signal is how a viewer is meant to be stopped; the server may or may not raise it again.
    print()
    # Python would wait for threads in the middle of a computation that nobody wants any more.
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _fragment(options: argparse.Namespace) -> str:
    """What of `--state` only the page knows to restore."""
    from app.state_text import of_a_window

    text = of_a_window(options.state or "")
    return f"#{text}" if text else ""


def _announce(listening: socket.socket, token: str, options: argparse.Namespace) -> None:
    """Print the URL, and open it where there is a screen to open it on."""
    from app.guard import LOOPBACK_NAMES

    port = listening.getsockname()[1]
    host = DEFAULT_HOST if options.host in ("0.0.0.0", "::", "localhost") else options.host
    url = f"http://{f'[{host}]' if ':' in host else host}:{port}/{token}/{_fragment(options)}"
    print(f"cgf-viewer: {url}  (Ctrl-C stops it)", flush=True)
    if options.host not in LOOPBACK_NAMES:
        cli.note(options, "Other machines that know this URL can use it, with this machine's name or address in it.")
    if options.no_browser:
        return
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        # Without a screen, a text browser would take over the terminal.
        cli.note(options, f"No screen here; from another machine: ssh -L {port}:127.0.0.1:{port} THIS_MACHINE")
        return
    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
