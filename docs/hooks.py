"""Lets pages link to files of the repository that are not pages, as in `../results/figures/x.png`.

Such a link works where the repository is read. For the site, a picture is copied beside the pages, and any
other file becomes a link into the repository. A file that does not exist fails the build.
"""

import re
from pathlib import Path

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"\]\(\.\./([^)#\s]+)")


def on_page_markdown(markdown: str, *, page, config, files: Files) -> str:
    """The page with its links out of docs/ replaced."""

    def replaced(link: re.Match[str]) -> str:
        path = ROOT / link[1]
        if not path.exists():
            raise PluginError(f"{page.file.src_uri}: link to '../{link[1]}', and there is no such file")
        if path.suffix != ".png":
            kind = "tree" if path.is_dir() else "blob"
            return f"]({config.extra['repository']}/{kind}/main/{link[1]}"
        if files.get_file_from_path(link[1]) is None:
            files.append(File.generated(config, link[1], abs_src_path=str(path)))
        return f"]({link[1]}"

    return LINK.sub(replaced, markdown)
