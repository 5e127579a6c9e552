"""The backend as a child process that speaks JSON-RPC on its stdin and stdout: `python -m primdiffusion.serve`."""
