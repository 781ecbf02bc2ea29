"""README.md and docs/ are true: examples run (test_examples.py), and every link, file, function and setting exists."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
EXAMPLES = {path.read_text(encoding="utf-8") for path in (HERE / "examples").glob("*.py")}
PAGES = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
         for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))}
TREES = ("pagas_cl", "cl_kernels", "filters", "tests", "docs")
NAMED = re.compile(rf"`((?:{'|'.join(TREES)})/[\w/.-]+\.\w+)(?::([\w.]+))?`")
COMMENTS = [path for tree in TREES for path in (ROOT / tree).rglob("*")
            if path.suffix in {".py", ".cl", ".clh"} and path.resolve() != Path(__file__).resolve()]


def test_every_python_block_is_an_example_that_runs():
    blocks = [block for text in PAGES.values() for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)]
    assert sorted(blocks) == sorted(EXAMPLES)


def test_the_readme_itself_shows_the_main_job():
    assert len(re.findall(r"```python\n", PAGES["README.md"])) >= 3


def test_every_picture_of_the_gallery_is_small_and_has_its_command():
    sections = PAGES[str(Path("docs", "gallery.md"))].split("\n## ")[1:]
    assert len(sections) >= 6
    for section in sections:
        (picture,) = re.findall(r"!\[[^]]+\]\(([^)]+)\)", section)
        assert (ROOT / "docs" / picture).stat().st_size < 150_000 and re.search(r"\n    (pagas-cl|python) ", section)


@pytest.mark.parametrize("page", PAGES)
def test_every_linked_file_exists(page):
    links = re.findall(r"\]\((?!https?:)([^)#]*)(?:#[^)]*)?\)", PAGES[page])
    assert not [link for link in links if link and not ((ROOT / page).parent / link).exists()]
    assert links or page != "README.md"


@pytest.mark.parametrize("page", PAGES)
def test_every_linked_heading_exists(page):
    for link, heading in re.findall(r"\]\((?!https?:)([^)#]*)#([^)]*)\)", PAGES[page]):
        text = ((ROOT / page).parent / link).read_text(encoding="utf-8") if link else PAGES[page]
        headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
        assert heading in {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in headings}, link


def names(path: Path, word: str) -> bool:
    """Whether `word` is defined or used as a name in the file, outside lines that are all comment."""
    line = rf"^(?!\s*(?://|#(?!define))).*\b{word}\b\s*[(:={{ ]"
    return re.search(line, path.read_text(encoding="utf-8"), flags=re.MULTILINE) is not None


@pytest.mark.parametrize("page", PAGES)
def test_every_file_and_function_that_a_page_names_exists(page):
    named = set(NAMED.findall(PAGES[page]))
    assert not sorted(path for path, _ in named if not (ROOT / path).is_file())
    assert not sorted(f"{path}:{word}" for path, word in named if word and not names(ROOT / path, word))


@pytest.mark.parametrize("page", PAGES)
def test_every_setting_that_a_page_names_exists(page):
    from pagas_cl.config import setting_names

    stages = {name.partition(".")[0] for name in setting_names()}
    found = set(re.findall(rf"`((?:{'|'.join(sorted(stages))})\.[a-z_]+)(?: = [^`]*|=[^`]*)?`", PAGES[page]))
    assert found <= set(setting_names()), sorted(found - set(setting_names()))


def test_every_section_that_a_comment_names_exists():
    """And comments point into the repository: docs/method.md is the method."""
    sections = set(re.findall(r"^## (\d+)\. ", PAGES["docs/method.md"], flags=re.MULTILINE))
    for path in COMMENTS:
        words = re.sub(r"\n\s*(?://|#)?\s*", " ", path.read_text(encoding="utf-8"))
        for first, last in re.findall(r"[Mm]ethod(?:\.md)? sections? (\d+)(?: (?:to|and) (\d+))?", words):
            assert {first, last or first} <= sections, f"{path.relative_to(ROOT)} names method section {first}"


def test_the_picture_is_what_the_imports_say():
    done = subprocess.run([sys.executable, str(ROOT / "docs" / "draw_architecture.py"), "--check"], capture_output=True,
                          text=True)
    assert done.returncode == 0, done.stderr
