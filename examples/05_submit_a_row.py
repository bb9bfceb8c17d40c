"""Make a row of a diagnoser of your own, check it as everybody can, and render the tables. Then send the JSON file.

On the command line:

    fdi-gym evaluate b747-standard --diagnosers 02_write_a_diagnoser:mean_innovation_test --results leaderboards/results
    fdi-gym verify leaderboards/results/b747-standard/02_write_a_diagnoser.mean_innovation_test.json
    fdi-gym leaderboard
"""

import sys
from pathlib import Path
from tempfile import mkdtemp

from fdi_gym.evaluation import evaluate, load_suite
from fdi_gym.leaderboard import check_row, read_row, row_path, table, write_rows

sys.path.insert(0, str(Path(__file__).parent))
NAME = "02_write_a_diagnoser:mean_innovation_test"

if __name__ == "__main__":
    suite = load_suite("b747-standard").head(10)  # a row is made on the whole suite
    folder = Path(mkdtemp())
    command = f"fdi-gym evaluate {suite.name} --diagnosers {NAME}"
    rows, microseconds = evaluate(suite, [NAME, "null"], work=folder / "runs", jobs=1, command=command)
    write_rows(folder, suite, rows, microseconds)
    row = read_row(row_path(folder, suite.name, NAME))
    check_row(row, suite)
    print(table(list(rows.values()), microseconds))
    print(f"\n{len(row.outcomes)} episodes; every figure of {row.diagnoser} follows from them")
