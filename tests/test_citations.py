"""Citations of the paper: cited sections, tables, algorithms and figures exist, and fit the module that cites them."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# The paper's numbers, in the order of its LaTeX source.
SECTIONS = {
    **{"I": "introduction", "II": "related work", "III": "method", "IV": "experiments", "V": "conclusion"},
    **{"II-A": "hierarchical learning", "II-B": "sampling-based planning", "II-C": "conditional supervised learning"},
    "III-A": "PRM-based task graph",
    "III-B": "local skill learning: the low-level controller",
    "III-C": "PRM-guided skill discovery: data collection",
    "III-D": "Control Transformer and its value function",
    "III-E": "planning-guided fine-tuning",
    "III-F": "architecture",
    "III-G": "hyperparameters and training",
    "IV-A": "MuJoCo: mazes, local maps, baselines, transfer",
    "IV-B": "real robot: Turtlebot3",
}
TABLES = {"I": "hyperparameters", "II": "results in mazes"}
ALGORITHMS = {"1": "the whole method", "2": "controller", "3": "collection", "4": "recoveries"}
FIGURES = {str(number) for number in range(1, 8)}
# The sections that each module may cite. Add modules that cite the paper here.
TOPICS = {
    "prm": {"III-A", "III-G"},
    "roadmap": {"III-A"},
    "room_roadmap": {"III-A", "IV-B"},
    "guided": {"III-A"},
    "controller": {"III-B"},
    "sac": {"III-G"},
    "edges": {"III-B", "III-G"},
    "reward": {"III-G"},
    "differential_drive": {"IV-B"},
    "collect": {"III-C", "IV-A"},
    "transformer": {"III-D", "III-F"},
    "value": {"III-D", "III-F"},
    "fit": {"III-D"},
    "policy": {"III-D"},
    "settings": {"III-D", "III-G"},
    "baselines": {"IV-A"},
    "cql": {"IV-A"},
    "sac_alone": {"IV-A"},
    "transfer": {"IV-A"},
    "trajectories": {"III-C"},
    "rooms": {"IV-B"},
    "room_runs": {"IV-B"},
    "maze_env": {"III-G", "IV-A"},
    "robots": {"III-G", "IV-A"},
    "occupancy": {"IV-A", "IV-B"},
    "lidar": {"IV-B"},
    "turtlebot3": {"IV-B"},
    "turtlebot3_world": {"IV-B"},
    "pages": {"IV-A", "IV-B"},
    "tables": {"IV-A", "IV-B"},
}
KINDS = {
    "section": (re.compile(r"\b((?:I{1,3}|IV|V)-[A-Z])\b|\bsec(?:\.|tion) ([IVX]+)\b(?!-)"), SECTIONS),
    "table": (re.compile(r"\b[Tt]able ([IVX]+|\d+)\b"), TABLES),
    "algorithm": (re.compile(r"\bAlg(?:orithm|\.) (\d+)"), ALGORITHMS),
    "figure": (re.compile(r"\b[Ff]ig(?:ure|\.) (\d+)"), FIGURES),
}
SHORTENED = re.compile(
    r"\b[IVX]+-[A-Z](?:,| and| to) (?:[A-Z]|-[A-Z])\b"
)  # "III-C and E": hides a section from the test

MODULES = sorted(f for folder in ("ct_jax", "envs", "experiments", "benchmarks") for f in (ROOT / folder).rglob("*.py"))
TESTS = sorted(file for file in (ROOT / "tests").glob("*.py") if file != Path(__file__))
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]


def name_of(file: Path) -> str:
    return str(file.relative_to(ROOT))


def topic_of(file: Path) -> str:
    return file.parent.name if file.stem == "__init__" else file.stem


def citations(text: str, kind: str) -> Iterator[str]:
    """The cited numbers of one kind in a text, such as "III-A", "I", "4"."""
    for match in KINDS[kind][0].finditer(text):
        yield next(number for number in match.groups() if number)


def wrong_citations(text: str) -> list[str]:
    """Citations that do not exist in the paper, and lists of sections that are abbreviated."""
    missing = [
        f"{kind} {number}"
        for kind, (_, known) in KINDS.items()
        for number in citations(text, kind)
        if number not in known
    ]
    return missing + SHORTENED.findall(text)


@pytest.mark.parametrize("file", [*MODULES, *TESTS, *PAGES], ids=name_of)
def test_citations_exist_in_paper(file):
    assert not wrong_citations(file.read_text("utf-8"))


@pytest.mark.parametrize("file", MODULES, ids=name_of)
def test_module_cites_sections_of_its_topic(file):
    assert set(citations(file.read_text("utf-8"), "section")) <= TOPICS.get(topic_of(file), set())


def test_all_topics_are_modules():
    assert TOPICS.keys() <= {topic_of(file) for file in MODULES}
    assert {section for allowed in TOPICS.values() for section in allowed} <= SECTIONS.keys()


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("(paper, sec. III-H)", ["section III-H"]),
        ("(paper, sec. IV-D): the robot", ["section IV-D"]),
        ("| IV-C: robots | `a.py` |", ["section IV-C"]),
        ("see section VI", ["section VI"]),
        ("(paper, sec. III-C and E)", ["III-C and E"]),
        ("(paper, table III)", ["table III"]),
        ("Table 2", ["table 2"]),
        ("Algorithm 5: x", ["algorithm 5"]),
        ("figure 8", ["figure 8"]),
        ("(paper, sec. III-D and III-F, table II, figure 6, Algorithm 4; sec. IV)", []),
    ],
)
def test_wrong_citation_is_found(text, found):
    assert wrong_citations(text) == found
