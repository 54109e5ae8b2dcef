"""`python -m wbc_bench` is `wbc-bench`."""

from wbc_bench.cli.main import main

if __name__ == "__main__":
    main()
