"""What reaches the terminal: no control characters of files, no floods, no long values."""

import ast
import json
import math
from pathlib import Path

import pytest
from commands.study import tiny
from commands.sweep import mini
from commands.test_cli import call, called, one_line

from thincam_jax._core.table import Table
from thincam_jax._core.text import escaped
from thincam_jax.commands import terminal

EVIL = "\x1b[31m\x07\u202e[/red]\x9b\r\u2028"
METHOD = (
    "{name: a, kind: wiener, synthesis: separate, shots: [{beta: 25 rad/mm^2, distance: 3 mm}]}"
)
IN_YAML = '"' + EVIL.encode("unicode_escape").decode() + '"'


def require_plain(text):
    wrong = {c for c in text if not c.isprintable()} - {"\n"}
    assert not wrong, wrong
    assert "x1b[31m" in text


@pytest.mark.parametrize(
    "changed",
    [
        {"--set": f"{EVIL}=1"},
        {"--set": f"kind={IN_YAML}"},
        {"--set": f"sensor={IN_YAML}"},
        {"--set": f"sensor.pitch={IN_YAML}"},
        {"--out": f"/dev/null/{EVIL}"},
        {"file": EVIL},
        {"line": f"{IN_YAML}: 3"},
    ],
)
def test_an_error_shows_no_control_characters(changed, tmp_path):
    file = tiny.write(tmp_path)
    if "line" in changed:
        file.write_text(file.read_text("utf-8") + changed["line"] + "\n", "utf-8")
    options = [text for key in ("--set", "--out") if key in changed for text in (key, changed[key])]
    result = call("run", changed.get("file", file), *options)
    assert result.exit_code != 0 and len(result.stderr.split("\n")) == 2, result.stderr
    require_plain(result.stderr)


def test_what_is_printed_shows_no_control_characters(tmp_path, capsys):
    result = called("init", "study", "--out", tmp_path / f"{EVIL.replace('/', '')}.yaml")
    require_plain(result.stdout)
    terminal.warn([EVIL])
    terminal.show(Table((EVIL,), ((EVIL,),), title=EVIL))
    with terminal.progress_bar("{task.fields[rate]}") as bar:
        bar.add_task(EVIL, total=1, rate=EVIL)
        shown = bar.get_renderable()
        with bar.console.capture() as capture:
            bar.console.print(shown)
    said = capsys.readouterr()
    for text in (said.out, said.err, capture.get()):
        require_plain(text)
    assert escaped("β = 25 rad/mm², “π”\n") == "β = 25 rad/mm², “π”\n"


def test_all_is_printed_in_one_place():
    folder = Path(terminal.__file__).parent
    printing = [
        f"{path.relative_to(folder)}:{node.lineno}"
        for path in folder.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if path.name != "terminal.py" and getattr(node, "id", "") == "print"
    ]
    assert not printing, f"use say of commands/terminal.py: {printing}"


def test_many_faults_are_cut(tmp_path):
    file = tiny.write(tmp_path)
    keys = "".join(f"key_{number}: 1\n" for number in range(2000))
    file.write_text(file.read_text("utf-8") + keys, "utf-8")
    lines = call("run", file).stderr.splitlines()
    assert len(lines) == 11 and lines[-1] == "thincam: and 1,990 more"
    assert "key_9: unknown key; allowed here: " in lines[9]


@pytest.mark.parametrize(
    "entry",
    ["{}=1", "kind={}", "sensor={}", "sensor.pitch={}", "scenes={}", "targets.0.image={}", "{}"],
)
def test_a_long_value_is_cut(entry, tmp_path):
    result = call("run", tiny.write(tmp_path), "--set", entry.format("x" * 5000))
    (line,) = result.stderr.splitlines()
    assert result.exit_code == 2 and len(line) < 700, line


@pytest.mark.thorough
def test_results_as_json(tmp_path):
    """An object in a line, and nothing else; the table holds the numbers that are not rounded."""
    file = mini.write(tmp_path)
    result = called("run", file, "--out", tmp_path / "out", "--json")
    table, report = (json.loads(line) for line in result.stdout.splitlines())
    assert table["table"]["headings"][0] == "method" and table["table"]["rows"][0][0] == "single"
    assert table["table"]["rows"][0][-1] == pytest.approx(25 / math.pi, rel=0.005)  # βR/π
    assert report == {"report": f"{tmp_path}/out/report.html"}


def test_quiet_commands_print_nothing(tmp_path):
    result = call("init", "study", "--out", tmp_path, "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    assert "name: study\n" in (tmp_path / "study.yaml").read_text("utf-8")
    # The options hold for one command alone, and errors are still reported.
    assert "kind" in call("init").stdout and call("init", "no", "--quiet").stderr


def test_a_near_miss_is_told_what_to_write(tmp_path):
    file, path = mini.write(tmp_path), "methods.*.shots.*.beta"
    assert f"write {path}" in one_line(call("sweep", file, "--grid", "beta=20:30:3", "--dry-run"))
    followed = call("sweep", file, "--grid", f"{path}=20:30:3 rad/mm^2", "--dry-run")
    assert followed.exit_code == 0 and "3 points" in followed.stdout, followed.output


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("line", "wrong", "advice", "right"),
    [
        ("explain FILE --set {}", "mask.width=2", 'a length such as "180 mm"', "mask.width=180mm"),
        ("explain FILE --set {}", "mask.widht=2mm", "allowed here: width, ", "mask.width=2mm"),
        ("explain FILE --set {}", "wavelength=532mm", "give 10 nm to 0.1 mm", "wavelength=10nm"),
        (
            "explain FILE --set {}",
            "model=seperable",
            "'closed_form', 'separable'",
            "model=separable",
        ),
        ("explain FILE --set {}", "methods=1", "write it as [a, b]", f"methods=[{METHOD}]"),
        ("explain FILE --set {}", "seed=1.5", "input should be a valid integer", "seed=1"),
        ("sweep FILE --grid {} --dry-run", "seed=1,1", "give each once", "seed=1,2"),
        (
            "sweep FILE --grid {} --dry-run",
            "seed=1:3:0",
            "give from 1 to 100000 values",
            "seed=1:3:1",
        ),
        ("sweep FILE --grid seed=1,2 --dry-run --workers {}", "0", "give at least 1", "1"),
        ("{} FILE --dry-run", "design", "is a study; give it to 'thincam run'", "run"),
    ],
)
def test_what_a_line_advises_can_be_followed(line, wrong, advice, right, tmp_path):
    file = str(mini.write(tmp_path))

    def started(value):
        return call(*(word.replace("FILE", file).format(value) for word in line.split()))

    assert advice in one_line(started(wrong))
    end = started(right)
    assert end.exit_code == 0, end.output
