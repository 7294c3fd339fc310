"""The command `quadsim reproduce`.

It flies the scenarios of a paper and compares each published number with ours; a difference beyond its tolerance gives
exit status 1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from quadsim.features.arguments import File, Watched
from quadsim.scenarios.catalogue import paper_names

if TYPE_CHECKING:
    from quadsim.features.papers.reproduction import Reproductions

    PaperName: TypeAlias = File
else:
    from quadsim.features.arguments import one_of

    Reproductions = Any
    PaperName = one_of(paper_names)


def reproduce(
    paper: PaperName | None = None, /, *, junit: File | None = None, progress: Watched = True
) -> Reproductions:
    """Reproduce papers' numbers: theirs, ours, difference; exit 1 if one is off.

    A number is published, obtained by running the authors' code, or by another implementation: a column and a count
    each.  Claims, which are put as numbers, and bars, published of something else, are counted apart.

    Args:
        paper: name, or path to a TOML file (default: every shipped paper).
        junit: also write each number's verdict as JUnit XML.
        progress: as in `fly`.

    Returns:
        One reproduction per paper: its `numbers` with `ours`, `difference` and `within`, `counts`, and a table, `grid`.

    Raises:
        InputError: the paper does not exist, or one of its numbers cannot be flown.

    Examples:
        >>> import quadsim
        >>> (paper,) = quadsim.reproduce("quadrotor-uav", progress=False)
        >>> paper.within, paper.numbers[2].spec.published, round(paper.numbers[2].ours, 3)
        (True, 250.0, 250.0)
    """
    from quadsim.console.junit import junit_file, write_junit
    from quadsim.console.progress import reporting
    from quadsim.console.results import after
    from quadsim.features.papers.reproduction import Reproductions, load_paper, reproduce_paper

    verdict_file = None if junit is None else junit_file(junit)
    if paper is None:
        names = paper_names()
    else:
        names = [str(paper)]
    papers = [load_paper(name) for name in names]
    reproduced = []
    with reporting(progress, "the flights") as report:
        for spec in papers:
            reproduced.append(reproduce_paper(spec, report))
    reproductions = Reproductions(reproduced)
    if verdict_file is not None:
        with after(reproductions, verdict_file):
            write_junit(reproductions, verdict_file)
    return reproductions
