"""The commands. They import what they use when they run, so that `fab4d --help` is quick."""

import re
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fab4d import __version__
from fab4d.errors import ArtifactError, DesignRejectedError, Fab4dError, InterruptedRunError
from fab4d.runner.table import stage_table

if TYPE_CHECKING:
    from fab4d.io.meshes import RawMesh
    from fab4d.runner.display import Display
    from fab4d.runner.job import Job
    from fab4d.runner.runner import Selection
    from fab4d.runner.workspace import Workspace

# EX_USAGE of sysexits.h, for click's own 2 would look like a rejected design.
USAGE_EXIT_CODE = 64

STAGE_HELP = {
    "check": "Check the two shapes and the scene: the mesh doctor.",
    "solve": "Find where SMP goes and where to pull, still grey.",
    "threshold": "Round the material to SMP and TPE and clean it up.",
    "refit": "Fit the held positions to the rounded material.",
    "verify": "Simulate the rounded design anew, from the permanent shape.",
    "sensitivity": "Tell whether the state is stable and what must be done carefully.",
    "judge": "Give the verdict that print files and rig sheet carry.",
    "bodies": "Write the watertight bodies to print.",
    "slice": "Slice the bodies and compare.",
    "rig": "Write the sheet to stand at the rig with.",
    "report": "Write the report, the curve of error and the verified state.",
}


class Commands(click.Group):
    """A group in the order of its definition, whose usage errors have an exit code of their own."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        return list(self.commands)

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        with _usage_errors_end_the_command():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> Any:
        with _usage_errors_end_the_command():
            return super().invoke(ctx)


@contextmanager
def _usage_errors_end_the_command() -> Iterator[None]:
    try:
        yield
    except click.UsageError as error:
        error.show()
        raise click.exceptions.Exit(USAGE_EXIT_CODE) from error


class Command(click.Command):
    """A command that ends with a message and the exit code of its error; --debug shows the trace."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.params.append(click.Option(["--debug"], is_flag=True, help="Show the trace of an error."))

    def invoke(self, ctx: click.Context) -> Any:
        debug = ctx.params.pop("debug")
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise
        except (Fab4dError, OSError, KeyboardInterrupt) as error:
            if debug:
                traceback.print_exception(error)
            known = _known(error)
            click.echo(f"fab4d: {known}", err=True)
            return ctx.exit(known.exit_code)


def _known(error: BaseException) -> Fab4dError:
    if isinstance(error, Fab4dError):
        return error
    return ArtifactError(str(error)) if isinstance(error, OSError) else InterruptedRunError("stopped")


def _scene_command(function: Callable[..., None]) -> Callable[..., None]:
    """What every command on a scene takes."""
    out = click.option(
        "--out", type=click.Path(path_type=Path), help="Run folder; runs/<name of the scene> if not given."
    )
    return click.argument("scene", type=click.Path(path_type=Path))(out(function))


@click.group(cls=Commands)
@click.version_option(__version__, prog_name="fab4d")
def main() -> None:
    """From two shapes of one part to print files and a rig sheet for 4D printing.

    SCENE is a TOML file, or a folder with a scene.toml.
    """


@main.command(cls=Command)
@_scene_command
@click.option("--from", "first", type=click.Choice(stage_table().names), help="Take what earlier stages left as it is.")
@click.option("--until", "last", type=click.Choice(stage_table().names), help="Stop after this stage.")
@click.option("--pick", metavar="ROW", help="Go on from this row of `fab4d tradeoff`; none: search again.")
@click.option("--force", is_flag=True, help="Run the stages even where they are current.")
@click.option("--quiet", is_flag=True, help="Show no progress.")
def run(
    scene: Path, out: Path | None, first: str | None, last: str | None, pick: str | None, force: bool, quiet: bool
) -> None:
    """Make the whole design. Finished stages are skipped, a stopped run goes on."""
    from fab4d.runner.runner import Selection

    stages = [stage.name for stage in stage_table().between(first, last)]
    if not stages:
        msg = f"--from {first} comes after --until {last}: the order is {', '.join(stage_table().names)}"
        raise click.UsageError(msg)
    job = _open_job(scene, out)
    if pick is not None:
        _pick(job, pick, stages, quiet)
    _run(job, Selection(first, last, frozenset(stages if force else ())), quiet)


def _pick(job: "Job", row: str, stages: list[str], quiet: bool) -> None:
    """Put the row in the place of what stage solve would search."""
    from fab4d.runner.pick import pick_row
    from fab4d.runner.runner import Selection, execute

    if "solve" not in stages:
        msg = f"--pick {row} takes the place of stage solve, which --from or --until leaves out"
        raise click.UsageError(msg)
    execute(job, Selection(last="check"), _display(quiet))
    with job.workspace.locked():
        pick_row(job, row)


def _run(job: "Job", selection: "Selection", quiet: bool) -> None:
    """Run, tell the verdict or how far it went, and raise DesignRejectedError for a rejected design."""
    from fab4d.report.verdict import REJECTED
    from fab4d.runner.runner import execute
    from fab4d.runner.summary import file_lines, report_lines, unfinished_lines

    execute(job, selection, _display(quiet))
    finished = selection.last in (None, job.table.names[-1])
    report = job.workspace.load("report_json") if finished else None
    lines = report_lines(report) if report else unfinished_lines(job, selection.last)
    click.echo("\n".join([*lines, *file_lines(job.workspace)]))
    if report and report["verdict"] == REJECTED:
        first, *others = report["reasons"]
        msg = f"design rejected: {first}{f' (and {len(others)} more)' if others else ''}"
        raise DesignRejectedError(msg)


def _open_job(scene_path: Path, out: Path | None) -> "Job":
    from fab4d.io.scene import load_scene
    from fab4d.runner.job import Job
    from fab4d.runner.workspace import Workspace

    scene = load_scene(scene_path)
    folder = out or Path("runs") / _file_name(scene.name)
    file = scene_path / "scene.toml" if scene_path.is_dir() else scene_path
    sources = {"scene": file, "permanent": scene.permanent, "temporary": scene.temporary}
    return Job(stage_table(), Workspace(folder, stage_table().artifacts), scene, sources, _read_mesh)


def _file_name(name: str) -> str:
    """`name` as a folder name on every system."""
    return re.sub(r"[^\w.-]+", "-", name).strip(".-") or "scene"


def _read_mesh(path: Path) -> "RawMesh":
    from fab4d.io.meshes import read_mesh

    return read_mesh(path)


def _display(quiet: bool) -> "Display":
    from fab4d.runner.display import SilentDisplay, TerminalDisplay

    return SilentDisplay() if quiet else TerminalDisplay(sys.stderr)


def _stage_command(name: str) -> click.Command:
    """The command that runs up to stage `name`."""

    @main.command(name, cls=Command, help=f"{STAGE_HELP[name]} Runs the stages that it needs.")
    @_scene_command
    @click.option("--force", is_flag=True, help=f"Run {name} even where it is current.")
    @click.option("--quiet", is_flag=True, help="Show no progress.")
    def stage(scene: Path, out: Path | None, force: bool, quiet: bool) -> None:
        from fab4d.runner.runner import Selection

        _run(_open_job(scene, out), Selection(None, name, frozenset({name} if force else ())), quiet)

    return stage


@main.command(cls=Command)
@_scene_command
def plan(scene: Path, out: Path | None) -> None:
    """Tell what would run, how long, and what is left out."""
    from fab4d.runner.outlook import plan_lines

    with tempfile.TemporaryDirectory() as folder:
        doctor = _checked(_open_job(scene, Path(folder)))
        lines = plan_lines(_open_job(scene, out), doctor.load("mesh"), doctor.load("check_report"))
    click.echo("\n".join(lines))


@main.command(cls=Command)
@_scene_command
@click.option("--points", metavar="N,N,...", help="Numbers of points; up to the goal's max_forces if not given.")
@click.option("--prices", metavar="P,P,...", help="Prices of SMP, as multiples of the usual one (lam_SMP).")
@click.option("--force", is_flag=True, help="Make finished rows again.")
@click.option("--quiet", is_flag=True, help="Show no progress.")
def tradeoff(scene: Path, out: Path | None, points: str | None, prices: str | None, force: bool, quiet: bool) -> None:
    """Show what SMP and points buy: error of many designs, to pick one from.

    Finished rows are kept, a stopped tradeoff goes on. `fab4d run SCENE --pick ROW` makes the design of a row.
    """
    from fab4d.runner.runner import execute_study
    from fab4d.runner.tradeoff import tradeoff_summary

    given = {"points": _numbers("--points", points, int), "prices": _numbers("--prices", prices, float)}
    job = _open_job(scene, out)
    most = job.scene.rig.max_points
    if given["points"] and max(given["points"]) > most:
        msg = f'--points {max(given["points"])}: the rig "{job.scene.rig.name}" pulls at most {most}'
        raise click.UsageError(msg)
    options = {name: values for name, values in given.items() if values is not None}
    execute_study(job, "tradeoff", options, force, _display(quiet))
    click.echo("\n".join(tradeoff_summary(job.workspace)))


@main.command(cls=Command)
@_scene_command
@click.option("--force", is_flag=True, help="Simulate finished cases again.")
@click.option("--quiet", is_flag=True, help="Show no progress.")
def stress(scene: Path, out: Path | None, force: bool, quiet: bool) -> None:
    """Check numerical stability: the design with stiff and extreme materials.

    The finished design is loaded, cooled and unloaded anew with stiffness contrasts and bulk moduli up to a thousand
    times as large, in other sizes and far from the origin. Runs the stages that it needs; finished cases are kept.
    """
    from fab4d.runner.runner import execute_study
    from fab4d.runner.stress import stress_summary

    job = _open_job(scene, out)
    execute_study(job, "stress", {}, force, _display(quiet))
    click.echo("\n".join(stress_summary(job.workspace)))


def _numbers(option: str, text: str | None, kind: type) -> tuple[Any, ...] | None:
    """Numbers above 0 that are separated by commas."""
    if text is None:
        return None
    try:
        numbers = tuple(kind(word) for word in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(0 < number < float("inf") for number in numbers):
        msg = f"{option} takes {'whole ' if kind is int else ''}numbers above 0 with commas between them, not {text!r}"
        raise click.UsageError(msg)
    return numbers


@main.command(cls=Command, help=STAGE_HELP["check"])
@_scene_command
def check(scene: Path, out: Path | None) -> None:
    from fab4d.runner.summary import doctor_lines

    with tempfile.TemporaryDirectory() as folder:
        report = _checked(_open_job(scene, out or Path(folder))).load("check_report")
    click.echo("\n".join(doctor_lines(report)))


def _checked(job: "Job") -> "Workspace":
    """The run folder of `job` with stage check done."""
    from fab4d.runner.runner import Selection, execute

    execute(job, Selection(last="check"), _display(quiet=True))
    return job.workspace


for _stage in stage_table().between("solve", "judge"):
    _stage_command(_stage.name)


@main.command(cls=Command, help=f"{STAGE_HELP['bodies']} Runs the stages that it needs.")
@click.argument("scene", metavar="SCENE|MESH", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Run folder; runs/<name of the scene> if not given.")
@click.option("--labels", metavar="FIELD", help="Take MESH, a tet mesh, with this cell field: 1 is SMP, 0 is TPE.")
@click.option("--units", help="Of MESH: mm if not given, cm, m or in.")
@click.option("--printer", metavar="CARD", help="For MESH; generic-dual-0.4 if not given.")
@click.option("--up", metavar="X,Y,Z", help="Direction of MESH that points up on the printer; 0,0,1 if not given.")
@click.option("--materials", metavar="CARD", help="For MESH; paper-corrected if not given.")
@click.option("--force", is_flag=True, help="Run bodies even where it is current.")
@click.option("--quiet", is_flag=True, help="Show no progress.")
def bodies(scene: Path, out: Path | None, labels: str | None, force: bool, quiet: bool, **of_mesh: str | None) -> None:
    from fab4d.runner.runner import Selection
    from fab4d.runner.summary import body_lines

    given = {name: value for name, value in of_mesh.items() if value is not None}
    if labels is None and given:
        msg = f"--{next(iter(given))} goes with --labels; a scene says it itself"
        raise click.UsageError(msg)
    if labels is None:
        job = _open_job(scene, out)
        _run(job, Selection(None, "bodies", frozenset({"bodies"} if force else ())), quiet)
        workspace = job.workspace
    else:
        workspace = _labelled_workspace(scene, out, labels, **given)
    click.echo("\n".join(body_lines(workspace.load("bodies_report"))))


def _labelled_workspace(
    mesh: Path, out: Path | None, field: str, units: str = "mm", printer: str = "", materials: str = "", up: str = ""
) -> "Workspace":
    """A run folder with the bodies of a labelled mesh."""
    from fab4d.io.cards import load_material, load_printer
    from fab4d.io.meshes import read_labelled_mesh
    from fab4d.io.scene import DEFAULT_CARDS
    from fab4d.runner.summary import file_lines
    from fab4d.runner.workspace import Workspace
    from fab4d.stages._labelled import labelled_bodies
    from fab4d.units import mm_per

    workspace = Workspace(out or Path("runs") / f"{_file_name(mesh.stem)}-bodies", stage_table().artifacts)
    raw, smp = read_labelled_mesh(mesh, field)
    card = load_printer(printer or DEFAULT_CARDS["printer"], Path())
    cards = (
        replace(card, up=_direction(up) if up else card.up),
        load_material(materials or DEFAULT_CARDS["materials"], Path()),
    )
    artifacts = labelled_bodies(raw, smp, mm_per(units), mesh.stem, *cards)
    with workspace.locked():
        workspace.save(artifacts)
    click.echo("\n".join(file_lines(workspace)))
    return workspace


def _direction(text: str) -> tuple[float, float, float]:
    """The unit vector that --up gives."""
    from fab4d.io.tables import direction

    try:
        return direction([float(word) for word in text.split(",")])
    except ValueError as error:
        msg = f'--up takes three numbers with commas, not all zero, as in 0,0,1, not "{text}"'
        raise click.UsageError(msg) from error


@main.command("slice", cls=Command, help=f"{STAGE_HELP['slice']} Makes the bodies first if needed.")
@click.argument("scene", metavar="SCENE|RUN", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Run folder; runs/<name of the scene> if not given.")
@click.option("--slicer", type=click.Choice(["prusa", "cura"]), help="The first that is installed if not given.")
@click.option("--quiet", is_flag=True, help="Show no progress.")
def slice_command(scene: Path, out: Path | None, slicer: str | None, quiet: bool) -> None:
    from fab4d.errors import SliceError
    from fab4d.io.slicers import find_slicer
    from fab4d.runner.runner import Selection, execute
    from fab4d.runner.summary import slice_lines
    from fab4d.runner.workspace import Workspace
    from fab4d.stages.slice import slice_report

    workspace = Workspace(scene, stage_table().artifacts)
    job = None if workspace.exists("bodies_report") else _open_job(scene, out)
    program = find_slicer(slicer)  # before bodies are made, which may take minutes
    if job is not None:
        execute(job, Selection(last="bodies"), _display(quiet))
        workspace = job.workspace
    with workspace.locked():
        reads = stage_table().stage("slice").reads
        inputs = {name: workspace.load(name) if workspace.exists(name) else None for name in reads}
        _refuse_missing_files(workspace, inputs)
        report = slice_report(program, inputs)
        workspace.save({"slice_report": report})
    click.echo("\n".join(slice_lines(report)))
    failed = [check for check in report["checks"] if not check["ok"]]
    if failed:
        msg = f"{program.program}: {failed[0]['check']} differs by {failed[0]['value']:.2%} of the volume"
        raise SliceError(msg)


def _refuse_missing_files(workspace: "Workspace", inputs: Mapping[str, Any]) -> None:
    """Raise ArtifactError for a print file that the bodies' report tells of and that is gone."""
    needed = ["part_3mf", *(f"{name}_stl" for name in inputs["bodies_report"]["bodies"])]
    for name in needed:
        if inputs[name] is None:
            msg = f"{workspace.path(name)} is missing: make it again with `fab4d bodies SCENE --force`"
            raise ArtifactError(msg)


for _stage in stage_table().between("rig", None):
    _stage_command(_stage.name)


@main.command(cls=Command)
def cards() -> None:
    """List the cards that come with fab4d: materials, printers, rigs."""
    from fab4d.runner.summary import card_lines

    click.echo("\n".join(card_lines()))


@main.command(cls=Command)
@click.argument("folders", metavar="[RUN_FOLDER]...", nargs=-1, type=click.Path(path_type=Path))
@click.option("--markdown", is_flag=True, help="Print the table in Markdown.")
@click.option("--plot", type=click.Path(path_type=Path), help="Draw the errors over run time into this PNG file.")
def bench(folders: tuple[Path, ...], markdown: bool, plot: Path | None) -> None:
    """Compare finished runs: error against run time.

    Without a RUN_FOLDER, all finished runs in runs/. Errors are relative to the diagonal of the part; tau is the time
    of one factorisation.
    """
    from fab4d.report.bench import bench_lines, bench_plot
    from fab4d.runner.finished import finished_roots, finished_run
    from fab4d.runner.workspace import write_files

    runs = [finished_run(folder) for folder in folders or finished_roots(Path("runs"))]
    if plot:
        write_files({plot: bench_plot(runs)})
    click.echo("\n".join(bench_lines(runs, markdown)))
