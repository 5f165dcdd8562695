"""Controllers that learned ones are compared with, as policies for `plant_loop`."""
