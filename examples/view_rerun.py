"""The quadruped falls into its stance, seen by Rerun: into a file here, in a window with rerun_view(client)."""

from urlab_client import URLabClient
from urlab_client.integrations.view import rerun_view

with URLabClient("sim://quadruped?play", step_mode="direct") as client:
    client.discover()
    client.reset()
    with rerun_view(client, save="quadruped.rrd", sensors=True) as view:
        for _ in range(500):
            client.step()
print(f"quadruped.rrd: {view.stats.states} states shown, {view.stats.dropped_states} left out; open it with: rerun")
