"""The command line as a person meets it: quick help, one sentence for an error, the right exit code."""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mistyle.cli.main import USED, main, parser
from mistyle.cli.options import NUMBER, with_values
from mistyle.core.paths import scenes


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "mistyle", *arguments], capture_output=True, text=True)


def test_help_answers_at_once():
    run("--help")
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        assert run("--help").returncode == 0
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.5


@pytest.mark.parametrize("verb", ["stylize", "demo", "render", "bake"])
def test_every_verb_explains_itself(verb, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([verb, "--help"])
    assert stopped.value.code == 0
    assert "--preset" in capsys.readouterr().out


def every_verb() -> dict[str, argparse.ArgumentParser]:
    """All verbs of the command line by name."""
    (verbs,) = (action for action in parser()._actions if isinstance(action, argparse._SubParsersAction))
    return dict(verbs.choices)


def test_help_lists_ten_verbs_first_and_the_others_under_more():
    text = parser().format_help()
    commands, more = text.split("commands:")[1].split("examples:")[0].split("more:")

    def listed(part: str) -> list[str]:
        return [line.split()[0] for line in part.splitlines() if line.startswith("  ") and line[2] != " "]

    assert listed(commands) == list(USED)
    assert {*listed(commands), *listed(more), "doctor"} == set(every_verb())
    assert not set(USED) & set(listed(more))
    assert "mistyle doctor" in text.splitlines()[-1]


@pytest.mark.parametrize("verb", every_verb())
def test_every_verb_has_examples(verb):
    text = every_verb()[verb].format_help()
    assert f"mistyle {verb}" in text.partition("examples:")[2]


def test_options_name_existing_settings():
    from mistyle.cli.main import OPTIONS
    from mistyle.jobs.settings import known_keys
    from mistyle.stylization.settings import Settings

    assert set(OPTIONS.values()) <= set(known_keys(Settings))


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["stylize"], 2, "stylize needs MESH, STYLE, -o OUT"),
        (["stylize", "a.obj", "b.png", "-o", "x", "--set", "fit.crop=1"], 2, "did you mean 'fit.crops'"),
        (["stylize", "absent.obj", "b.png", "-o", "OUT"], 3, "absent.obj"),
        (["render", "absent.obj", "-o", "OUT"], 3, "absent.obj"),
    ],
)
def test_trouble_is_one_sentence_and_a_code(arguments, code, sentence, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == code
    said = capsys.readouterr().err
    assert sentence in said and "Traceback" not in said
    assert not list(tmp_path.iterdir()), "a refused job leaves nothing behind"


@pytest.mark.parametrize("path", ["x" * 300, "loop/file"], ids=["long", "loop"])
@pytest.mark.parametrize(
    "line",
    [
        "stylize {} {} -o OUT",
        "stylize {robot} {} -o OUT",
        "stylize {robot} {painting} -o {}",
        "stylize {robot} {painting} -o OUT --config {}",
        "render {robot} -o {}",
        "bake {robot} {} -o OUT",
        "fit {robot} {} -o OUT",
        "fit --scene {} --list",
        "compare {} {painting} -o OUT",
        "compare {painting} {painting} -o {}",
        "batch {} -o OUT",
        "batch {scenes} -o {}",
        "export {} -o OUT",
        "verify {}",
        "view {}",
        "lookdev {} -o OUT",
    ],
)
def test_a_path_that_the_system_cannot_follow_is_named(line, path, capsys, tmp_path, monkeypatch):
    """Names that are too long and links to themselves, as every verb's input and output."""
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    monkeypatch.chdir(tmp_path)
    files = {"robot": scenes() / "robot.obj", "painting": scenes() / "demo_mosaic.jpg", "scenes": scenes()}
    assert main([word.format(path, **files) for word in line.split()]) in (2, 3)
    said = capsys.readouterr().err
    assert path in said and "Traceback" not in said
    assert [found.name for found in tmp_path.iterdir()] == ["loop"]


def test_errors_are_json_where_asked(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["stylize", "absent.obj", "b.png", "-o", "OUT", "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["exit_code"] == 3


def test_print_config_reads_back(capsys):
    assert main(["stylize", "--preset", "draft", "--seed", "7", "--print-config"]) == 0
    assert "seed = 7" in capsys.readouterr().out


def test_unknown_verbs_are_refused():
    with pytest.raises(SystemExit) as stopped:
        parser().parse_args(["stylise"])
    assert stopped.value.code == 2


def test_without_words_the_help_is_printed(capsys):
    assert main([]) == 2
    assert "commands" in capsys.readouterr().out


def test_words_that_are_too_many_are_named(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["stylize", "my", "chair.glb", "b.png", "-o", "x"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err.startswith("mistyle stylize: found 'b.png' beside the arguments that it takes")


def verbs(top, name=""):
    """Every verb's parser by name, those of verbs of verbs too."""
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            for key, each in action.choices.items():
                yield from verbs(each, f"{name} {key}".strip())
    if name:
        yield name, top


def of_one_value(verb):
    return [(action, text) for action in verb._actions if action.nargs is None for text in action.option_strings]


@pytest.mark.parametrize(("name", "verb"), list(verbs(parser())))
def test_unknown_options_name_the_nearest(name, verb, capsys):
    """Two letters exchanged in every long option of every verb, and an option that resembles none."""
    if verb._subparsers is not None:
        return
    options = [text for text in verb._option_string_actions if len(text) > 6 and text != "--help"]
    for option in [*options, "--zzzzzz"]:
        wrong = option[:4] + option[5] + option[4] + option[6:]
        if wrong in verb._option_string_actions:
            continue
        with pytest.raises(SystemExit) as stopped:
            verb.parse_known_args([wrong])
        said = capsys.readouterr().err
        assert stopped.value.code == 2
        required = "the following arguments are required" in said
        assert required or (said.startswith(f"mistyle {name}: there is no option '{wrong}'") and said.count("\n") == 1)
        assert required or ("did you mean '--" in said) == (option in options)


@pytest.mark.parametrize(("name", "verb"), list(verbs(parser())))
def test_a_wrong_command_line_is_an_object_where_json_is_asked_for(name, verb, capsys):
    if verb._subparsers is not None:
        return
    for words in (["--zzzzzz"], ["--json", "--zzzzzz"]):
        with pytest.raises(SystemExit):
            verb.parse_known_args(words)
        answer = capsys.readouterr()
        if "--json" in words:
            found = json.loads(answer.out)
            assert found["exit_code"] == 2 and answer.err.startswith(f"mistyle {name}: {found['error']}")
        else:
            assert answer.out == ""


@pytest.mark.parametrize(("name", "verb"), list(verbs(parser())))
def test_values_may_begin_with_a_dash(name, verb, monkeypatch):
    """Numbers and choices after every option of every verb; argparse alone expects an argument."""
    for action in verb._actions:
        action.required = False
        action.nargs = action.nargs if action.option_strings or action.nargs in ("?", "*") else "?"
    monkeypatch.setattr(verb, "exit_on_error", False)
    for action, option in of_one_value(verb):
        numbers = ["-1", "-1e-3", "-0.5,1", "-.5", "-3cm"]
        for value in numbers if action.choices is None else [c for c in action.choices if str(c).startswith("-")]:
            try:
                given = getattr(verb.parse_known_args([option, value])[0], action.dest)
            except argparse.ArgumentError as error:
                assert "expected one argument" not in str(error) and value in str(error)
                continue
            wanted = value if action.type is None else action.type(value)
            assert given == [wanted] if isinstance(given, list) else given == wanted


@pytest.mark.parametrize(("name", "verb"), list(verbs(parser())))
def test_an_option_is_no_value_of_another(name, verb):
    texts = [text for action in verb._actions for text in action.option_strings]
    assert not [text for text in texts if NUMBER.match(text)]
    for _, option in of_one_value(verb):
        for other in (*texts, "-oOUT", "--", "-x", "-"):
            assert with_values(verb, [option, other]) == [option, other]


def test_the_up_axis_is_taken_as_it_is_named():
    words = ["fit", "m.obj", "shots", "--up", "-y", "-o", "out", "--hold", "-1"]
    with pytest.raises(SystemExit):  # --hold begins two options
        parser().parse_args(words)
    given = parser().parse_args([*words[:-2], "--iter", "-1"])
    assert (given.up, given.out, given.iterations) == ("-y", Path("out"), -1)
    assert with_values(parser(), ["--", "--up", "-y"]) == ["--", "--up", "-y"]


@pytest.mark.parametrize("verb", ["stylize", "demo", "render", "bake", "fit"])
def test_print_config_needs_nothing_else(verb, capsys):
    assert main([verb, "--print-config", "--memory", "3G"]) == 0
    assert "memory = 3.0" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "wanted"),
    [(["render"], "MESH, -o OUT"), (["render", "a.obj"], "-o OUT"), (["bake", "a.obj"], "VIEWS, -o OUT")],
)
def test_without_it_what_is_missing_is_named(words, wanted, capsys):
    assert main(words) == 2
    assert f"{words[0]} needs {wanted}" in capsys.readouterr().err


def test_a_scene_fit_refuses_an_option_that_it_would_ignore(capsys):
    assert main(["fit", "--scene", "room.xml", "--report", "none", "--list"]) == 2
    assert "--report belongs to a fit of MESH" in capsys.readouterr().err
