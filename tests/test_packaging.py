"""The distribution: its wheel has everything that runs need, and works where there is no checkout."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest

import experiments
from mechanics.yaml_input import read_yaml
from tests.experiments.conftest import free_port

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PACKAGES = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
#: as in the paper's own source
TITLE = "Tactile-Driven Non-Prehensile Object Manipulation via Extrinsic Contact Mode Control"
AUTHORS = [("Miquel", "Oller"), ("Dmitry", "Berenson"), ("Nima", "Fazeli")]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=100)
    [file] = folder.glob("*.whl")
    return file


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="what belongs to the packages is asked of git: a checkout")
def test_the_wheel_has_every_file_of_the_packages_that_git_has(wheel):
    listed = subprocess.run(["git", "ls-files", "-z", *PACKAGES], cwd=ROOT, check=True, capture_output=True, timeout=20)
    tracked = {name for name in listed.stdout.decode().split("\0") if name and (ROOT / name).exists()}
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    assert not tracked - packed
    assert {Path(name).suffix for name in tracked} >= {".yaml", ".msg", ".json", ".js", ".css", ".j2", ".md", ".typed"}
    assert {name.split("/")[0] for name in packed} == set(PACKAGES)  # nothing of the tests, or of the documentation


def test_the_version_stands_in_one_place(wheel):
    with zipfile.ZipFile(wheel) as archive:
        [name] = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
        told = archive.read(name).decode()
    assert f"\nVersion: {experiments.__version__}\n" in told
    command = [sys.executable, "-m", "experiments.cli", "--version"]
    said = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True, timeout=60).stdout
    assert said == f"extrinsic {experiments.__version__}\n"
    assert f"## {experiments.__version__}" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_every_package_says_that_it_is_typed():
    assert all((ROOT / name / "py.typed").is_file() for name in PACKAGES)


def test_the_extra_of_the_emulators_has_what_a_franka_needs():
    extras = PROJECT["project"]["optional-dependencies"]
    assert set(extras["franka"]) <= set(extras["emulators"])


def against_the_format(citation):
    """Hold a file against the Citation File Format's own schema, which the checker brings along."""
    check = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.citation-file-format", str(citation)]
    return subprocess.run(check, cwd=ROOT, check=False, capture_output=True, text=True, timeout=60)


def test_the_citation_is_valid_in_its_format(tmp_path):
    pytest.importorskip("check_jsonschema", reason="check-jsonschema is not installed")
    said = against_the_format(ROOT / "CITATION.cff")
    assert said.returncode == 0, said.stdout + said.stderr
    wrong = tmp_path / "CITATION.cff"
    wrong.write_text((ROOT / "CITATION.cff").read_text("utf-8").replace("conference-paper", "talk"))
    said = against_the_format(wrong)
    assert said.returncode == 1
    assert "'talk' is not one of" in said.stdout


def test_the_citation_refers_to_the_paper():
    cited = read_yaml(ROOT / "CITATION.cff").data
    assert cited["license"] == PROJECT["project"]["license"]
    # `preferred-citation` would have the paper cited in place of the software, which its authors have not written
    assert "preferred-citation" not in cited
    [paper] = cited["references"]
    assert paper["title"] == TITLE
    assert [(author["given-names"], author["family-names"]) for author in paper["authors"]] == AUTHORS
    assert TITLE in re.sub(r"\s+", " ", (ROOT / "README.md").read_text("utf-8"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The wheel alone in a new environment, which sees the installed dependencies but not this checkout."""
    home = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(home)], check=True, timeout=100)
    python = home / "bin" / "python"
    into = ["--python", str(python), "install", "--quiet", "--no-deps", "--no-index", str(wheel)]
    subprocess.run([sys.executable, "-m", "pip", *into], check=True, timeout=100)
    [packages] = home.glob("lib/python*/site-packages")
    # a path in a .pth file is searched after the environment's own, and the .pth files within it are not read
    (packages / "dependencies.pth").write_text(f"{Path(np.__file__).parent.parent}\n")
    return home / "bin"


@pytest.mark.slow  # every kernel is compiled anew
@pytest.mark.timeout(600)
def test_init_and_run_work_from_an_installed_wheel_outside_the_checkout(installed, tmp_path):
    env = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    env["PATH"] = f"{installed}{os.pathsep}{env['PATH']}"
    where = "import control, experiments; print(control.__file__, experiments.__file__)"
    asked = [str(installed / "python"), "-c", where]
    found = subprocess.run(asked, cwd=tmp_path, env=env, check=True, capture_output=True, text=True, timeout=60).stdout
    assert all(Path(file).is_relative_to(installed.parent) for file in found.split())
    settings = f"--set bus.endpoint=tcp/127.0.0.1:{free_port()} --set stages.0.parameters.steps=6"
    script = f"extrinsic init demo && cd demo && extrinsic run experiment.yaml {settings} --out run"
    shell = ["/bin/sh", "-c", script]
    done = subprocess.run(shell, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=560, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "next: cd demo && extrinsic run experiment.yaml" in done.stdout
    run = tmp_path / "demo" / "run"
    assert {file.name for file in run.iterdir()} >= {"experiment.yaml", "log.mcap", "results.json", "report.html"}
    assert "pivot-closed_loop-0" in done.stdout
