"""The site of these pages: `make docs` builds it into build/docs, without the network."""

from experiments import __version__

project = "extrinsic"
author = "The extrinsic authors"
copyright = author
version = release = __version__

extensions = ["myst_parser"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["deploy", "notebooks"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
myst_links_external_new_tab = False
nitpicky = True

html_theme = "furo"
html_title = f"extrinsic {release}"
html_static_path = ["_static"]
html_css_files = ["extrinsic.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#00677f", "color-brand-content": "#00677f"},
    "dark_css_variables": {"color-brand-primary": "#5cc4dc", "color-brand-content": "#5cc4dc"},
}
pygments_style = "friendly"
pygments_dark_style = "github-dark"
