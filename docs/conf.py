"""The site: the pages of docs/ and the API, built from the docstrings. `./go docs` builds it."""

from importlib.metadata import version as installed_version

from docutils.nodes import Element
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx

from gateway.cli.schema import FILES, markdown

project = "Motor Gateway"
version = release = installed_version("motor-gateway")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["conf.py"]
html_theme = "furo"
html_title = f"Motor Gateway {version}"
myst_heading_anchors = 3
suppress_warnings = ["myst.xref_missing"]  # links out of docs/, to files of the repository
autodoc_default_options = {"members": True, "undoc-members": False, "show-inheritance": True}
autodoc_typehints = "description"
autodoc_class_signature = "mixed"
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False


class KeysOf(Directive):
    """`{keys-of} robot 2`: every key of a kind of file, as `gateway schema robot --keys` prints it, with
    headings of level 2: one below that where it stands, else they are put at the end of the page."""

    required_arguments = 2

    def run(self) -> list[Element]:
        """Return the tables."""
        made = Element()
        kind, level = self.arguments
        lines = StringList(markdown(FILES[kind](), kind, int(level)).splitlines(), "gateway schema")
        self.state.nested_parse(lines, self.content_offset, made, match_titles=True)
        return list(made.children)


def setup(app: Sphinx) -> None:
    """Add the directive."""
    app.add_directive("keys-of", KeysOf)
