"""The program ``hipg-bench``, also as ``python -m hipg_bench``."""

from hipg_bench import processes


def main() -> None:
    """Run the command line."""
    processes.leave_out_the_working_folder()
    from hipg_bench import cli

    cli.main()


if __name__ == "__main__":
    main()
