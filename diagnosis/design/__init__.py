"""What to record next: an excitation that tells apart what a diagnosis could not, or moves what
never moved.

    python diagnose.py --next report/ --seconds 10
"""
