"""Sealed blind trials of the diagnosis. See diagnosis/trials/command.py.

python prove.py show --seed 1 --trial 15 --folder /tmp/t15
python prove.py run --seed 1 --trials 40 --out results/proof_dev.csv
"""

from diagnosis.trials.command import main

if __name__ == "__main__":
    main()
