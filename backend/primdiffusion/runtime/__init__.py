"""The process and its machine: devices, threads, memory, worker processes, what is said of errors."""
