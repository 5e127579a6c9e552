"""`python -m primdiffusion`, which is also what launchers of many processes start."""

from primdiffusion.cli import main

if __name__ == "__main__":
    main()
