"""Make a row of a diagnoser of your own, check it as everybody can, and render the tables. Then send row and outcomes.

On the command line, in this folder:

    fdi-gym evaluate b747-standard --diagnosers 02_write_a_diagnoser:mean_innovation_test --results results
    fdi-gym verify results/b747-standard/02_write_a_diagnoser.mean_innovation_test.json \\
        --trust 02_write_a_diagnoser:mean_innovation_test
    fdi-gym leaderboard --results results --pages results
"""

import sys
from pathlib import Path
from tempfile import mkdtemp

from fdi_gym.evaluation import evaluate
from fdi_gym.row import row_path, write_rows
from fdi_gym.suite import freeze, load_suite
from fdi_gym.tables import table
from fdi_gym.verification import verify

sys.path.insert(0, str(Path(__file__).parent))
NAME = "02_write_a_diagnoser:mean_innovation_test"

if __name__ == "__main__":
    folder = Path(mkdtemp())
    suite = load_suite("b747-standard").head(10)  # a row is made on the whole suite
    file = freeze(suite, folder)
    command = f"fdi-gym evaluate {file} --diagnosers {NAME}"
    found = evaluate(suite, [NAME, "null"], work=folder / "runs", jobs=1, command=command)
    write_rows(folder, suite, found)
    print(table([f.row for f in found.values()], {name: f.made.microseconds for name, f in found.items()}))
    episodes = verify(row_path(folder, suite.name, NAME), share=0.3, suite=str(file), trust=[NAME]).episodes
    print(f"\nevery figure of {NAME} follows from its episodes; run again with the same outcomes: {episodes}")
