"""Show the quadruped in Rerun as it drops into its stance. Saves a file; rerun_view(client) opens a window instead."""

from urlab_client import URLabClient
from urlab_client.integrations.view import rerun_view

with URLabClient("sim://quadruped?play", step_mode="direct") as client:
    client.discover()
    client.reset()
    with rerun_view(client, save="quadruped.rrd", sensors=True) as view:
        for _ in range(500):
            client.step()
print(f"quadruped.rrd: {view.stats.states} states shown, {view.stats.dropped_states} dropped; open it with: rerun")
