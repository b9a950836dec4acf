"""Formulas as MathML, made as the pages are built: browsers draw it by themselves, also without a network."""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml, pick_math_environment
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.math import get_node_equation_number

_log = logging.getLogger(__name__)
#: TeX takes one digit where the converter takes a whole number: \\tfrac12 is a half.
_ONE_DIGIT = re.compile(r"(\\[td]?frac|[_^])(\d)(?=\d)")


def mathml(node: nodes.Element, tex: str, block: bool) -> str:
    """MathML of a formula; what the converter does not know is a warning, which ends the build."""
    tex = _ONE_DIGIT.sub(r"\1{\2}", tex)
    try:
        return str(latex2mathml.tex2mathml(tex, as_block=block))
    except Exception as error:  # whatever it raises is about the formula
        _log.warning("the formula %r cannot be drawn: %s", tex, error, location=node)
        return f"<code>{tex}</code>"


def visit_inline(self: Any, node: nodes.math) -> None:
    self.body.append(self.starttag(node, "span", "", CLASS="math notranslate nohighlight"))
    self.body.append(mathml(node, node.astext(), block=False) + "</span>")
    raise nodes.SkipNode


def visit_block(self: Any, node: nodes.math_block) -> None:
    self.body.append(self.starttag(node, "div", CLASS="math notranslate nohighlight"))
    if node["number"]:
        self.body.append(f'<span class="eqno">({get_node_equation_number(self, node)})')
        self.add_permalink_ref(node, "Link to this equation")
        self.body.append("</span>")
    tex = node.astext().strip()
    if not node.get("no-wrap", node.get("nowrap")):
        environment = pick_math_environment(tex)
        tex = f"\\begin{{{environment}}}{tex}\\end{{{environment}}}" if environment != "equation*" else tex
    self.body.append(f"<div>{mathml(node, tex, block=True)}</div></div>")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
