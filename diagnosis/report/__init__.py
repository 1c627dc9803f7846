"""The report of a diagnosis: a page to look at, JSON to compute with, files to simulate with.

    from diagnosis.report import writer
    names = writer.write(diagnosis, "report/")

writer puts the files together; sections, cards and force say what is on the page; charts,
mechanism and overlay draw it; text has the words; page fills in templates/.
"""

from typing import Any, Protocol


class Diagnosis(Protocol):
    """What the report reads of a diagnosis; the estimator's own class has it.

    It may have two more: `located`, courses of the missing force, and `corrected_py`, the text of
    a script beside corrected.xml.
    """

    summary: dict[str, Any]  # diagnosis.json
    corrected_xml: str
    world: Any  # its `model` is the nominal MjModel
    settings: dict  # {Candidate: values}
    ranking: list[dict]  # candidates: effect, place, error_removed, p_value
    traces: list[dict]  # of held-out channels: time, measured, nominal, corrected
    train: list  # Recordings
    held_out: list
