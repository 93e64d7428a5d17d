"""The report of a run: one self-contained HTML page, and the gist of it as one PNG page.

``reading`` takes whatever a run folder holds, finished or not; ``words`` says in sentences what it means;
``pictures`` draws it; ``page`` and ``overview`` set it as HTML and as one picture.
"""

from pathlib import Path

from ct_envs.errors import UserError
from ct_jax.report.overview import write_overview
from ct_jax.report.page import page
from ct_jax.report.pictures import draw_maze, draw_paths
from ct_jax.report.reading import read_run

__all__ = ["draw_maze", "draw_paths", "write_report"]


def write_report(run: Path) -> Path:
    """Write ``report.html`` and ``report.png`` into a run folder, from as many of its stages as are there.

    Returns:
        The path of the HTML page.

    Raises:
        UserError: ``run`` is no run folder, or cannot be written to.
    """
    run = Path(run)
    found = read_run(run)
    html = run / "report.html"
    text = page(found)
    try:
        html.write_text(text, encoding="utf-8", errors="replace")
        write_overview(found, run / "report.png")
    except OSError as error:
        raise UserError(f"{run}: the report cannot be written ({error.strerror}); make the folder writable") from None
    return html
