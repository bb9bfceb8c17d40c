"""Show a filter the same flights that everybody else is shown, and read its scores."""

from pathlib import Path
from tempfile import mkdtemp

from fdi_gym.evaluation import evaluate
from fdi_gym.suite import load_suite
from fdi_gym.tables import confusion_table, table

suite = load_suite("b747-standard").head(20)  # 20 of its flights
names = ["null", "two_stage_kf", "two_stage_kf_exponential", "known_onset_oracle"]

if __name__ == "__main__":
    found = evaluate(suite, names, work=Path(mkdtemp()), jobs=1)
    print(table([f.row for f in found.values()], {name: f.made.microseconds for name, f in found.items()}))
    print()
    print(confusion_table(found["two_stage_kf_exponential"].row, [label.name for label in suite.build().labels]))
