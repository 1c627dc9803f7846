"""The public benchmark of hidden physics. See diagnosis/trials/command.py.

python prove.py show --seed 1 --trial 15 --folder /tmp/t15
python prove.py run --development --seed 1 --trials 60 --out results/development.csv
"""

from diagnosis.trials.command import main

if __name__ == "__main__":
    main()
