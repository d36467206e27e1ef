"""The memory, the threads and the processes that a run takes."""
