"""
What the documents show of the published results: protocol, tables and figures from the files in ``results``.

    python benchmarks/publish.py             protocol.yml, figures, the tables in the two README files and in tuning.md
    python benchmarks/publish.py --print     tables, printed only

A run that is to be published comes into results/<table>/<algorithm or variant>/<environment>, CSV and JSON.
"""

import argparse
from pathlib import Path

import pandas as pd
import yaml
from protocol import MAIN, describe_cells, deviation_column

from sb3_chdp.benchmark import figures, paper, tables
from sb3_chdp.benchmark.results import read_results
from sb3_chdp.benchmark.runs import display_name
from sb3_chdp.benchmark.statistics import scores_of
from sb3_chdp.registry import ALGORITHMS

ROOT = Path(__file__).parent
RESULTS = ROOT / "results"
README = ROOT / "README.md"
TUNING = ROOT / "tuning.md"
FIGURES = ROOT / "figures"
# Runs of CHDP with its one setting for all environments
ONE_SETTING = "one_setting"
# Of the ablations: tables, their rows, and the paper's success rates in percent in the order of the rows
TABLES = {"ablation": "Ablation with the paper's settings", "ablation_tuned": "Ablation with our settings"}
VARIANTS = ("full", "without_diffusion", "without_codebook", "without_sequential_update", "without_both")
PAPER_ABLATION = {
    "HardGoal-v0": ("81.8 ± 3.5", "49.8 ± 26.9", "73.3 ± 7.8", "53.5 ± 14.5", "52.4 ± 13.7"),
    "HardMove6-v0": ("94.4 ± 1.2", "88.2 ± 5.6", "56.1 ± 12.5", "92.3 ± 4.5", "54.6 ± 9.6"),
}
PROTOCOL_HEADER = (
    "# Written by benchmarks/publish.py from the files of the runs; what the keys mean: paper.py beside this file.\n"
)


def replace_section(path: Path, name: str, text: str) -> None:
    """Replace what stands between the two markers of a section of a Markdown file."""
    start, end = (f"<!-- {name}: {place} -->" for place in ("start", "end"))
    before, rest = path.read_text().split(start)
    path.write_text(f"{before}{start}\n{text}\n{end}{rest.split(end)[1]}")


def paper_column(row: str, env: str) -> str:
    """:return: what the paper prints for a variant"""
    return dict(zip(VARIANTS, PAPER_ABLATION[env], strict=True))[row]


def overview(scores: pd.DataFrame, rows: list[str], envs: list[str], today: pd.DataFrame) -> str:
    """
    :param scores: those of version 0.1.0
    :param rows: algorithms, CHDP first
    :param envs: environments
    :param today: scores of CHDP with its one setting
    :return: a line per environment: mean scores of CHDP, today and then, and of the best baseline, and the paper's figure
    """
    chdp, *baselines = rows
    means = scores.groupby(["env", "row"])["score"].mean()
    lines = []
    for env in envs:
        of_today = today.loc[today["env"] == env, "score"]
        best = max((row for row in baselines if (env, row) in means), key=lambda row: means[env, row])
        published = paper.paper_column(chdp, env).split()[0]
        cells = (
            f"{of_today.mean():.1f}" if len(of_today) else "-",
            len(of_today),
            f"{means[env, chdp]:.1f}",
            f"{means[env, best]:.1f} ({display_name(best)})",
        )
        lines.append([env, *map(str, cells), published])
    return tables.markdown(["environment", "CHDP", "seeds", "CHDP 0.1.0", "best baseline", "CHDP in the paper"], lines)


def one_setting(cells: list[paper.Cell], scores: pd.DataFrame) -> str:
    """:return: a line per environment: score, seed and commit of every run"""
    scores_of_runs = scores.set_index(["env", "seed"])["score"]
    lines = []
    for cell in cells:
        env, seeds = cell["environment"], cell["seeds"]
        values = tables.numbers(scores_of_runs[env, seed] for seed in seeds)
        lines.append([env, f"{cell['steps']:,}", *(", ".join(map(str, column)) for column in (values, seeds, seeds.values()))])
    return tables.markdown(["environment", "environment steps", "success, %", "seeds", "commits"], lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    protocol = describe_cells(RESULTS, MAIN)
    scores_today = scores_of(read_results(RESULTS / ONE_SETTING))
    today = one_setting(yaml_order(describe_cells(RESULTS, ONE_SETTING)), scores_today)
    results = read_results(RESULTS / MAIN)
    scores = scores_of(results)
    envs = tables.order(scores["env"], [cell["environment"] for cell in yaml_order(protocol)])
    rows = tables.order(scores["row"], list(ALGORITHMS))
    columns = {"paper": paper.paper_column, "settings": deviation_column(protocol)}
    parts = [tables.report(scores, rows, envs, columns)]
    for table, title in TABLES.items():
        ablation = scores_of(read_results(RESULTS / table))
        variants = tables.order(ablation["row"], list(VARIANTS))
        columns = {"paper": paper_column, "settings": deviation_column(describe_cells(RESULTS, table))}
        parts += [f"### {title}", tables.score_table(ablation, variants, tables.order(ablation["env"], []), columns)]
    text = "\n\n".join(parts)
    print(text, today, sep="\n\n")
    if args.only_print:
        return
    paper.PROTOCOL.write_text(PROTOCOL_HEADER + yaml.safe_dump(protocol, sort_keys=False, width=127))
    replace_section(README, "tables", text)
    replace_section(TUNING, "one setting", today)
    replace_section(ROOT.parent / "README.md", "tables", overview(scores, rows, envs, scores_today))
    for x, name in (("timesteps", "curves.png"), ("minutes", "curves_minutes.png")):
        figures.plot_curves(results, scores, rows, envs, x, FIGURES / name)
    figures.plot_scores(scores, rows, envs, FIGURES / "scores.png", paper.paper_mean)


def yaml_order(cells: list[paper.Cell]) -> list[paper.Cell]:
    """:return: cells in the order in which the paper lists their environments, others behind"""
    order = list(yaml.safe_load(paper.PAPER.read_text()))
    return sorted(cells, key=lambda cell: order.index(cell["environment"]) if cell["environment"] in order else len(order))


if __name__ == "__main__":
    main()
