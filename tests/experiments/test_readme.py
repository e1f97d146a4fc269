"""What the READMEs promise: the example runs, commands and files exist, numbers are those of the committed results."""

import ast
import json
import re
from pathlib import Path

import jax
import numpy as np
import pytest
import toys

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
PAGES = [Path("README.md")]
for _top in ("jaxtune", "envs", "experiments"):
    PAGES += sorted(page.relative_to(ROOT) for page in (ROOT / _top).rglob("*.md"))
MOST_LINES, MOST_WORDS = 180, 30
_RESULTS = ROOT / "experiments" / "results"
_NOT_PROSE = re.compile(r"^(#|\||!\[|<)")  # headings, tables, pictures, markup
_ITEM = re.compile(r"^\s*(?:[-*]|\d+\.)\s+")
_END = re.compile(r"(?<=[.!?])[)*\"]*\s+(?=[^a-z])")


def sentences(page: str) -> list[str]:
    """Sentences of a page's prose; code, tables, headings and pictures are left out."""
    page = re.sub(r"^```.*?^```", "\n", page, flags=re.DOTALL | re.MULTILINE)
    page = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", page)  # a link is read as its text
    blocks = [""]
    for line in page.splitlines():
        if not line.strip() or _NOT_PROSE.match(line):
            blocks.append("")
        elif _ITEM.match(line):
            blocks.append(_ITEM.sub("", line))
        else:
            blocks[-1] += " " + line.strip()
    return [sentence for block in blocks for sentence in _END.split(block.strip()) if sentence]


def module_path(name: str) -> Path | None:
    """File that `python -m name` runs, if there is one."""
    path = ROOT.joinpath(*name.split("."))
    found = [one for one in (path.with_suffix(".py"), path / "__main__.py") if one.is_file()]
    return found[0] if found else None


def test_embedding_example_finds_the_friction(monkeypatch):
    # The example learns for long enough to be compiled well.
    monkeypatch.setattr(jax, "jit", toys.long_jit)
    *_, code = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert sum(bool(line.strip()) for line in code.splitlines()) < 20
    scope = {}
    exec(code, scope)
    # The example's target has a friction of 0.8 in log space and its tuner starts at 0.
    assert abs(float(scope["state"].dist.centre["friction"]) - 0.8) < 0.1


def test_readme_is_short_enough_to_be_read():
    assert len(README.splitlines()) <= MOST_LINES


def test_sentences_are_separated_from_tables_code_and_headings():
    prose = "# A heading\nOne two\nthree. Four `x.y` five?\n\n- six\n  seven\n- eight\n"
    page = f"{prose}\n| a | b. C |\n```sh\nrun. This\n```\n"
    assert sentences(page) == ["One two three.", "Four `x.y` five?", "six seven", "eight"]


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_sentences_are_short(page):
    long = [one for one in sentences((ROOT / page).read_text()) if len(one.split()) > MOST_WORDS]
    assert not long


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_links_lead_to_files(page):
    links = re.findall(r"\]\(([^)#\s]+)[^)]*\)", (ROOT / page).read_text())
    missing = [link for link in links if "://" not in link and not ((ROOT / page).parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_commands_and_their_options_exist(page):
    # A field of a command's arguments is an annotated name of a class; options are spelt with hyphens.
    fields = {
        node.target.id
        for path in (ROOT / "experiments").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    text = (ROOT / page).read_text().replace("\\\n", " ")
    for name, rest in re.findall(r"python -m (experiments[\w.]*)([^\n`|#]*)", text):
        assert module_path(name.rstrip(".")), f"{name} is no command"
        unknown = set(re.findall(r"--([a-z-]+)", rest)) - {one.replace("_", "-") for one in fields}
        assert not unknown - {"help"}, f"{name} has no such option"


def test_commands_section_lists_every_command_once():
    (section,) = re.findall(r"^## Commands\n(.*?)^## ", README, re.DOTALL | re.MULTILINE)
    rows = re.findall(r"^\| (`[a-z].*?) \|", section, re.MULTILINE)
    listed = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(listed) == sorted(path.stem for path in (ROOT / "experiments").glob("[!_]*.py"))


def _range(values, digits: int) -> str:
    return f"{np.mean(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


@pytest.mark.parametrize("folder", ("mass_0.5X", "mass_1.5X", "weak_motor_bullet", "weak_motor_mujoco_c"))
def test_returns_of_the_results_table_are_those_of_the_runs(folder):
    methods = json.loads((_RESULTS / folder / "summary.json").read_text())["methods"]
    for result in methods.values():
        if len(result["return_end"]) > 1:
            assert _range(result["return_end"], 1) in README


@pytest.mark.parametrize("folder", ("mass_0.5X", "mass_1.5X"))
def test_errors_of_the_results_table_are_those_of_the_runs(folder):
    for result in json.loads((_RESULTS / folder / "summary.json").read_text())["methods"].values():
        seen = ["thigh" in name or "shank" in name for name in result["param_names"]]
        errors = np.array(result["param_error_end"])[:, seen].mean(axis=1)
        if len(errors) > 1:
            assert _range(errors, 3) in README


def test_returns_of_the_stand_in_robot_are_those_of_the_runs():
    methods = json.loads((_RESULTS / "stand_in" / "fig6" / "summary.json").read_text())["methods"]
    for runs in methods.values():
        assert _range([run["end"]["return"] for run in runs], 1) in README


def test_errors_of_other_robots_are_those_of_the_runs():
    robots = json.loads((_RESULTS / "robots" / "summary.json").read_text())["robots"]
    page = (_RESULTS / "README.md").read_text()
    for group in ("in_box", "outside"):
        assert ", ".join(f"{found[group]['after']:.3f}" for found in robots.values()) in README
    for name, found in robots.items():
        inside, outside = (
            f"{found[group]['parameters']}: {found[group]['before']:.3f} -> {found[group]['after']:.3f}"
            for group in ("in_box", "outside")
        )
        assert re.search(rf"`{name}` .* {inside} \| {outside} \| {found['truth_in_last_box']:.2f} \|", page)


def test_rates_of_discovery_are_those_of_the_benchmark():
    table = {row["measure"]: row for row in json.loads((_RESULTS / "field_74" / "scores.json").read_text())["table"]}
    shown = "top-1 name, 5 floor units and more", "names something where nothing is hidden", "pairs: both named"
    for measure in shown:
        row = table[measure]
        assert f"{row['value']:.2f} ({row['low']:.2f} to {row['high']:.2f})" in README
    page = (ROOT / "experiments" / "discovery" / "README.md").read_text()
    for row in table.values():
        if row["goal"] and "low" in row and row["low"] is not None:
            assert f"| {row['count']} | {row['value']:.2f} ({row['low']:.2f} to {row['high']:.2f}) |" in page
