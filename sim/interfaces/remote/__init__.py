"""The Controller over HTTP: for planners that run in another process, on another machine, or in another language.

    python -m sim serve                                   # http://127.0.0.1:8265, this machine only
    DUALTHOR_TOKEN=... python -m sim serve host=0.0.0.0   # elsewhere too; the token is required then

Every client gets a world of its own in a process of its own, so that nothing a client does reaches another. A world that has
not been asked for a while is closed, and the number of worlds is limited. Requests and replies are JSON:

| request | body | reply |
|---|---|---|
| `POST /worlds` | arguments of `sim.interfaces.controller.Controller`, `images` | `{"world": id, "event": {...}}` |
| `POST /worlds/ID/step` | the mapping that `Controller.step` takes, `images` | `{"event": {...}}` |
| `DELETE /worlds/ID` | | `{}` |
| `GET /health` | | `{"version": 1, "worlds": n, "limit": n}` |

`images` lists what an event carries besides `metadata`: `frame`, `instance_segmentation_frame`, `third_party_camera_frames`
(PNG, base64) and `depth_frame` (`{"shape", "float32"}`: little-endian metres, base64); by default `["frame"]`. What the
Controller refuses with ValueError is status 400 with `{"error": message}`. `sim.interfaces.remote.client.RemoteController`
speaks this for Python.
"""
