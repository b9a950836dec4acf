"""Signatures as they are written: `ArrayLike` by its name, the axes of an array behind its type, links to what pages have."""

import re
from typing import Any

from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform

_ARRAY_LIKE = re.compile(r"[~\w.]*_Buffer \| .*?_NestedSequence\[complex \| bytes \| str\]")
_AXES = re.compile(r"[~\w.]*Annotated\[([~\w.]+), ('[^']*')\]")


def shortened(signature: str) -> str:
    """With unions that NumPy calls ArrayLike under that name, and `Annotated[T, 'axes']` as `T['axes']`."""
    return _AXES.sub(r"\1[\2]", _ARRAY_LIKE.sub("ArrayLike", signature))


def process(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Both parts of a signature, where there are any."""
    return signature and shortened(signature), returned and shortened(returned)


class Unlinked(SphinxPostTransform):
    """Types that no page has stay text: looking for each among all that pages have takes a sixth of the time of a build."""

    default_priority = 5  # before links are resolved

    def run(self, **kwargs: Any) -> None:
        names = self.env.domains.python_domain.objects
        ends = {end for name in names for end in (name, *(name[dot.end() :] for dot in re.finditer(r"\.", name)))}
        for node in list(self.document.findall(pending_xref)):
            if node.get("refspecific") and len(node) == 1 and node["reftarget"] not in ends:
                node.replace_self(node[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Runs when autodoc has written a signature."""
    app.connect("autodoc-process-signature", process)
    app.add_post_transform(Unlinked)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
