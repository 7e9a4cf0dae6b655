"""The row of a study that a person picks for a run."""

import json

import numpy as np

from fab4d.errors import ArtifactError
from fab4d.io.tables import nearest
from fab4d.runner.fingerprint import digest, staleness
from fab4d.runner.job import Job
from fab4d.runner.table import PICKED, Stage
from fab4d.runner.workspace import Checkpoints, kept_key

STUDY = "tradeoff"
NONE = "none"


def study_rows(job: Job, study: Stage) -> Checkpoints:
    """The finished rows of a study on the inputs as they are now; rows of other inputs are removed."""
    return Checkpoints(job.workspace.study_folder(study.name), _key(job, study))


def pick_row(job: Job, row: str) -> None:
    """Let the run go on with a row of the tradeoff; `none` takes that back. Stage check has to be current.

    Raises ArtifactError when there is no tradeoff, when it is of other inputs, or when it has no such row.
    """
    workspace, study = job.workspace, job.table.study(STUDY)
    if row == NONE:
        workspace.save({PICKED: None})
        return
    key, folder = _key(job, study), workspace.study_folder(STUDY)
    kept = kept_key(folder)
    if kept is None:
        msg = (
            f"{folder}: there is no tradeoff to pick {row} from: run `fab4d tradeoff` with this scene and folder first"
        )
        raise ArtifactError(msg)
    if kept != key:
        msg = f"{folder}: the tradeoff is of other inputs ({_what_changed(job, study)}): run `fab4d tradeoff` again"
        raise ArtifactError(msg)
    rows = study_rows(job, study)
    arrays = rows.restore(row) if row in row_names(rows) else None
    if arrays is None:
        msg = f"{folder}: the tradeoff has no row {row}; {nearest(row, row_names(rows))}"
        raise ArtifactError(msg)
    workspace.save({PICKED: arrays | {"inputs": np.array(key)}})


def row_names(rows: Checkpoints) -> list[str]:
    """The finished rows of a study, as it lists them."""
    index = rows.restore("index")
    return [] if index is None else index["names"].tolist()


def refuse_outdated_pick(job: Job, stage: Stage) -> None:
    """Raise ArtifactError when `stage` would go on from a row that was picked for other inputs."""
    if PICKED not in stage.reads or not job.workspace.exists(PICKED):
        return
    picked, study = job.workspace.load(PICKED), job.table.study(STUDY)
    if str(picked["inputs"]) != _key(job, study):
        row = json.loads(str(picked["row"]))["id"]
        msg = (
            f"{job.workspace.path(PICKED)}: row {row} was picked from a tradeoff of other inputs "
            f"({_what_changed(job, study)}): run `fab4d tradeoff` again and pick from it, or `fab4d run --pick {NONE}`"
        )
        raise ArtifactError(msg)


def _key(job: Job, study: Stage) -> str:
    return digest(job.fingerprint(study))


def _what_changed(job: Job, study: Stage) -> str:
    reason = staleness(job.workspace.manifest(study.name), job.fingerprint(study), job.written(study))
    return reason or "they changed"
