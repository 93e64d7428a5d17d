"""The report of a run: a self-contained HTML page, and a summary as one PNG picture.

``reading`` reads a run folder, which may be unfinished. ``words`` writes the sentences, ``pictures`` draws, and
``page`` and ``overview`` make the HTML page and the picture.
"""

from pathlib import Path

from ct_jax.report.overview import write_overview
from ct_jax.report.page import page
from ct_jax.report.pictures import draw_maze, draw_paths
from ct_jax.report.reading import read_run
from ct_jax.runtime.files import check_writable, write_text

__all__ = ["draw_maze", "draw_paths", "write_report"]


def write_report(run: Path) -> Path:
    """Write ``report.html`` and ``report.png`` into a run folder. Stages may be missing.

    Returns:
        The path of the HTML page.

    Raises:
        UserError: ``run`` is not a run folder, or cannot be written to.
    """
    run = Path(run)
    html, png = run / "report.html", run / "report.png"
    found = read_run(run)
    check_writable(html, png)
    write_text(html, page(found))
    write_overview(found, png)
    return html
