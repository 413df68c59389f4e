"""Sensor models compared with each other on a folder of scans without labels: agreement, conflict, KL both ways.

python compare_models.py FOLDER
"""

import sys
from collections.abc import Sequence

import ogm
from ogm.evaluation import AgreementEvaluation


def main(folder: str, models: Sequence[str] = ("ray", "height-band", "lite")) -> AgreementEvaluation:
    result = ogm.evaluation.evaluate_agreement(models, ogm.open_dataset(folder))
    print(result)  # the same as a dict, or in a DataFrame: result.table()
    return result


if __name__ == "__main__":
    main(sys.argv[1])
