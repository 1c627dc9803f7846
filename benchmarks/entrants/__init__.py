"""Other tools for the benchmark, each a script: python TOOL.py {model} {recordings} {out}."""
