"""Settings of the documentation, which `make docs` builds."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

import headbench

project = "headbench"
author = "the headbench authors"
copyright = "the headbench authors, Apache-2.0"
version = release = headbench.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "reference_pages",
]
exclude_patterns = ["_ext", "_static"]

myst_enable_extensions = ["colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_ivar = True
default_role = "public"
smartquotes_action = "D"  # dashes alone; quotes are part of what is quoted
add_module_names = False
python_display_short_literal_types = True
maximum_signature_line_length = 90

html_theme = "furo"
html_title = "headbench"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_copy_source = False
html_show_search_summary = False  # summaries would be fetched, which pages from a disk cannot do
html_show_sphinx = False
FONTS = {
    "font-stack": "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif",
    "font-stack--monospace": "ui-monospace, SFMono-Regular, Menlo, Consolas, 'DejaVu Sans Mono', monospace",
}
html_theme_options = {
    "light_css_variables": {
        **FONTS,
        "color-background-primary": "#f7f7f5",
        "color-background-secondary": "#f0f0ed",
        "color-foreground-primary": "#1a1b1e",
        "color-foreground-muted": "#595c62",
        "color-brand-primary": "#3b3fb6",
        "color-brand-content": "#3b3fb6",
        "color-brand-visited": "#3b3fb6",
        "color-api-name": "#3b3fb6",
        "color-api-pre-name": "#595c62",
    },
    "dark_css_variables": {
        **FONTS,
        "color-background-primary": "#131417",
        "color-background-secondary": "#1a1c20",
        "color-foreground-primary": "#e9e9e6",
        "color-foreground-muted": "#a6a9af",
        "color-brand-primary": "#aeb2ff",
        "color-brand-content": "#aeb2ff",
        "color-brand-visited": "#aeb2ff",
        "color-api-name": "#aeb2ff",
        "color-api-pre-name": "#a6a9af",
    },
    "top_of_page_buttons": [],
}
