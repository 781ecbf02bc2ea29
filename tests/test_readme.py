"""The README's examples are those of tests/examples, which test_examples runs."""

import re
from pathlib import Path

HERE = Path(__file__).resolve().parent
README = (HERE.parent / "README.md").read_text(encoding="utf-8")
EXAMPLES = {path.read_text(encoding="utf-8") for path in (HERE / "examples").glob("*.py")}


def test_every_python_block_is_an_example_that_runs():
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert sorted(blocks) == sorted(EXAMPLES)


def test_every_linked_file_exists():
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    assert links and not [link for link in links if not (HERE.parent / link).exists()]
