"""`python -m primdiffusion.serve`."""

from primdiffusion.serve.server import main

main()
