"""One thread a process: the tests run on several processes, and small tensors gain nothing from more.

Ctrl-C is answered, also where the tests were started in the background of a shell, which lets its jobs ignore it.
"""

import signal

import torch

torch.set_num_threads(1)
signal.signal(signal.SIGINT, signal.default_int_handler)
