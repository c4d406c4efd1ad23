"""Checks of LaTeX tables by pdfLaTeX, where it is installed."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

ARTICLE = r"""\documentclass{article}
\usepackage{booktabs,graphicx}
\begin{document}
%s
\end{document}
"""


def depth(text):
    """Depth of unescaped braces at the end; -1 as soon as one closes that was not opened."""
    count = 0
    for brace in re.findall("[{}]", re.sub(r"\\.", "", text)):
        count += 1 if brace == "{" else -1
        if count < 0:
            return -1
    return count


def compile_latex(texts, folder):
    """Compile tables in one article; the text of pdfLaTeX's log.

    Asserts that there is a page, no error, no label that two tables have and no box that is wider than its line.
    """
    if shutil.which("pdflatex") is None:
        pytest.skip("pdflatex is not installed")
    names = []
    for number, text in enumerate(texts):
        Path(folder, f"table{number}.tex").write_text(text, encoding="utf-8")
        names.append(rf"\input{{table{number}}}")
    Path(folder, "paper.tex").write_text(ARTICLE % "\n\\clearpage\n".join(names), encoding="utf-8")
    words = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-no-shell-escape", "paper.tex"]
    subprocess.run(words, cwd=folder, capture_output=True, check=False, timeout=120)
    log = Path(folder, "paper.log").read_text(encoding="latin-1")
    assert Path(folder, "paper.pdf").is_file(), log[-2000:]
    assert re.search(r"^!|multiply[- ]defined|Overfull \\hbox", log, re.MULTILINE) is None, log[-2000:]
    return log
