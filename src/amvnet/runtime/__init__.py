"""Control the memory, the threads and the processes of a run."""
