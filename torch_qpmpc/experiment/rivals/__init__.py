"""Controllers to compare with: policies for `torch_qpmpc.envs.closed_loop.plant_loop`."""
