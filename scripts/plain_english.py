"""Measure how plain the English of Markdown pages, docstrings, attribute docs and comments is.

    python scripts/plain_english.py PATH... [--worst 20]

Prints a row for each file or folder. `--worst` lists the sentences to rewrite first.
Documentation of Gymnasium, stable-baselines3, LeRobot and rerun has 0.0 to 0.7 nominal relatives
and 0.2 to 0.6 banned words per 1,000 words, 0 to 0.7 % docstrings that open with a clause, and 10
to 14 words per sentence.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

RELATIVE = re.compile(
    r"(?:^|[.;:,(] |\b(?:and|or|of|by|for|with|to|in|on|than|is|are|as|but|at|from|says?|tells?"
    r"|knows?|sees?|all) )(?:what|who|whoever|whatever|those (?:that|who|of|whose)"
    r"|ones? (?:that|of|whose|with)|that of)\b(?! (?:if|about)\b)",
    re.IGNORECASE,
)
"""Clauses in place of nouns: "what is told", "those that fly"."""

BANNED = re.compile(
    r"\b(?:told|tells?|asked|asks?|said|is none|are none|that is none|nobody|somebody|whoever"
    r"|goes on|go on|went on|given up|gives up|otherwise than|other than it|to the bit|as late as"
    r"|so long|so many|so much|of its own|of one's own|by itself|let go of|is worth|greatest"
    r"|farthest|further (?:cameras?|ones?)|the way to|whereabouts|stands? (?:still|there|here)|anew"
    r"|once more|no more|any more|likewise|meanwhile|therein|thereof)\b",
    re.IGNORECASE,
)
"""Words with a usual technical term in their place: reported, NaN, maximum, resume."""

CLAUSE = re.compile(
    r"^(?:What|Whether|How|Where|When|Who|Whose|That|Which|Of|By|As|Those|So|If|None|To whom)\b"
)
"""First word of a docstring that opens with a clause."""

_SENTENCE_END = re.compile(r"(?<=[.!?:;])\s+(?=[A-Z\"(`\[])")
_SHORTEST_SENTENCE = 4
_STRING_OR_COMMENT = re.compile(
    r"'''(?:\\.|[^\\])*?'''|\"\"\"(?:\\.|[^\\])*?\"\"\"|'(?:\\.|[^'\\\n])*'|\"(?:\\.|[^\"\\\n])*\"|(#[^\n]*)",
    re.DOTALL,
)
_HELP_KEYWORDS = ("description", "help")


@dataclass
class Prose:
    """Sentences and docstrings of files."""

    sentences: list[str] = field(default_factory=list)
    docs: list[str] = field(default_factory=list)
    """Docstrings, attribute docs and help texts."""

    def add(self, paragraphs: Iterable[str]) -> None:
        """Add the sentences of paragraphs."""
        for paragraph in paragraphs:
            for sentence in _SENTENCE_END.split(paragraph):
                if len(sentence.split()) >= _SHORTEST_SENTENCE:
                    self.sentences.append(sentence)

    def add_markdown(self, text: str) -> None:
        """Add a Markdown page."""
        self.add(_paragraphs(text))

    def add_python(self, text: str, tree: ast.Module) -> None:
        """Add a module's docstrings, attribute docs, help texts and comments."""
        docs = list(_docs(tree, help_texts=any(f"{name}=" in text for name in _HELP_KEYWORDS)))
        self.docs += [doc.strip() for doc in docs]
        for doc in docs:
            self.add(_paragraphs(re.sub(r"^\s+", "", doc, flags=re.MULTILINE)))
        self.add(_comments(text))

    def measures(self) -> dict[str, float]:
        """Return words per sentence, relatives and banned words per 1,000 words, clauses [%]."""
        words = max(1, sum(len(sentence.split()) for sentence in self.sentences))
        relatives = sum(len(RELATIVE.findall(sentence)) for sentence in self.sentences)
        banned = sum(len(BANNED.findall(sentence)) for sentence in self.sentences)
        clauses = sum(bool(CLAUSE.match(doc)) for doc in self.docs)
        return {
            "relatives_per_1000_words": 1000 * relatives / words,
            "banned_per_1000_words": 1000 * banned / words,
            "clause_percent": 100 * clauses / max(1, len(self.docs)),
            "words_per_sentence": words / max(1, len(self.sentences)),
        }


def source_files(path: Path, *patterns: str) -> list[Path]:
    """Return a file, or the files of some patterns below a folder, without generated ones."""
    if path.is_file():
        return [path]
    found = [file for pattern in patterns for file in path.rglob(pattern)]
    return sorted(file for file in found if "__pycache__" not in file.parts)


def read_prose(path: Path) -> Prose:
    """Return the prose of a file, or of a folder's Markdown and Python files."""
    prose = Prose()
    for file in source_files(path, "*.md", "*.py"):
        text = file.read_text(encoding="utf-8")
        if file.suffix == ".md":
            prose.add_markdown(text)
        else:
            prose.add_python(text, ast.parse(text))
    return prose


def _comments(text: str) -> Iterator[str]:
    """Yield the comments of a module, consecutive lines joined."""
    block, end = "", 0
    for match in _STRING_OR_COMMENT.finditer(text):
        if not match[1]:
            continue
        if text[end : match.start()].strip() and block:
            yield block
            block = ""
        block, end = f"{block} {match[1].lstrip('# ')}".strip(), match.end()
    yield block


def _paragraphs(text: str) -> list[str]:
    """Return the paragraphs of a Markdown page without code, tables, headings and links."""
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    kept, fenced = [], False
    for line in text.split("\n"):
        if re.match(r"\s*(```|~~~)", line):
            fenced = not fenced
        elif not fenced:
            kept.append("" if re.match(r"\s*(\||#|:::|===|---|\+-)", line) else line)
    plain = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", "\n".join(kept))
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", plain)
    plain = re.sub(r"`+[^`]*`+|<[^>]+>|https?://\S+", "CODE", plain)
    parts = re.split(r"\n\s*\n|\n\s*(?=[-*+] |\d+\. )", re.sub(r"[*_]{1,3}", "", plain))
    return [
        re.sub(r"\s+", " ", re.sub(r"^\s*([-*+]|\d+\.)\s+", "", part.strip())) for part in parts
    ]


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield a tree's node and all statements below it, without their expressions."""
    yield tree
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case)):
            yield from statements(child)


def _docs(tree: ast.Module, *, help_texts: bool) -> Iterator[str]:
    """Yield docstrings, attribute docs and, with `help_texts`, those of options and fields."""
    for node in ast.walk(tree) if help_texts else statements(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            if isinstance(statement, ast.Expr):
                yield from _text(statement.value)
        if isinstance(node, ast.keyword) and node.arg in _HELP_KEYWORDS:
            yield from _text(node.value)


def _text(node: ast.expr) -> Iterator[str]:
    """Yield the value of a string constant."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value


def main() -> None:
    """Print the measures of each path, and the worst sentences."""
    parser = argparse.ArgumentParser(description="Measure how plain the English of files is.")
    parser.add_argument("paths", nargs="+", type=Path)
    parser.add_argument("--worst", type=int, default=0, help="sentences listed for each path")
    options = parser.parse_args()
    for path in options.paths:
        prose = read_prose(path)
        figures = (f"{name} {value:.2f}" for name, value in prose.measures().items())
        print(f"{path}: {', '.join(figures)}")
        scored = [
            (2 * len(RELATIVE.findall(s)) + len(BANNED.findall(s)), s) for s in prose.sentences
        ]
        for score, sentence in sorted(scored, reverse=True)[: options.worst]:
            print(f"  {score}  {sentence}")


if __name__ == "__main__":
    main()
