"""Which runs of `pagas-cl` are tested, as plain data: every command, option and effect has its place here.

test_paths_table.py says what has none: an option that is new is a word in a row of COMMANDS (or in ON_A_TERMINAL, where
many commands have it), an effect that is new is a line of MATRIX, such as the copy of another effect's line.
"""

from functools import cache
from typing import NamedTuple

import typer

from pagas_cl.__main__ import build_app, command_names

# Runs of `refine`, a column each; any two lines have any two of their arguments together in one column at least.
# path   mesh: --mesh to --output; keep: with --keep-mesh; fuse: with --fuse; new: depth maps to --output; maps: no mesh
# off    pixels by which the cameras are off
# run    once: in a pipe; more: in a terminal, then in a pipe, in the same folder; kill: in a pipe, killed once a view
#        is finished, then in a terminal, in the same folder
# call   the same from Python, with a function that progress is reported to, or none: the same bytes, so that those of
#        terminal and pipe are the same, too
MATRIX = """
path            mesh mesh mesh mesh keep keep keep keep fuse fuse fuse fuse new  new  new  new  maps maps maps maps
off             0    3    0    1    1    0    1    3    1    0    1    3    0    3    1    3    1    3    3    0
kind            .ply .off .stl .obj .obj .ply .stl .glb .off .stl .ply .obj .glb .stl .off .glb .obj .ply .off .glb
run             kill once once more kill kill more once more more once kill more kill kill once once more kill more
--quiet         yes  yes  yes  no   yes  yes  no   yes  no   no   no   yes  yes  no   no   yes  yes  no   no   yes
--report        no   yes  yes  no   yes  no   no   no   yes  no   yes  no   no   yes  yes  yes  no   no   yes  no
--save-depth    yes  yes  no   no   no   no   yes  yes  no   no   yes  no   no   yes  no   yes  yes  yes  yes  yes
--memory        no   no   no   yes  yes  yes  no   no   yes  yes  no   no   yes  no   yes  yes  yes  no   yes  no
--no-align      yes  yes  yes  yes  yes  yes  yes  yes  yes  yes  yes  yes  no   yes  no   no   yes  no   yes  yes
call            none none none bar  none none bar  none bar  none bar  bar  bar  bar  none bar  bar  none none none
occlusion       off  on   off  auto off  auto on   auto auto on   off  on   on   auto auto off  off  on   auto off
unseen_mask     on   on   auto off  auto off  on   on   auto on   off  on   off  off  auto on   auto auto on   off
exposure        on   off  auto off  on   auto off  auto auto on   on   off  auto off  auto on   auto off  on   off
view_dependence on   off  off  auto off  on   off  auto off  on   auto on   auto auto on   off  on   auto auto off
shading         auto auto off  on   auto off  on   off  on   on   off  auto off  auto on   on   auto auto on   off
antialiasing    auto off  on   auto on   off  on   auto auto off  on   off  off  auto on   on   off  auto auto on
smoothness      off  auto off  on   auto off  on   on   off  auto on   off  auto off  on   auto on   off  auto on
noise           on   auto off  off  on   auto off  auto on   auto on   off  on   on   auto off  auto off  on   off
pyramid         off  on   on   auto on   auto auto off  auto off  on   on   on   auto off  auto off  auto on   off
hypotheses      off  auto on   off  auto off  off  on   auto on   on   off  auto on   off  off  auto on   off  auto
mismatch        on   off  auto auto auto off  on   auto off  auto on   on   auto off  on   off  off  auto on   on
resemblance     auto on   off  off  auto on   on   off  off  auto on   off  on   auto on   off  auto on   off  auto
consistency     off  off  auto on   on   auto off  on   off  on   on   auto off  on   auto auto on   off  auto auto
agreement       off  auto auto on   auto on   on   off  off  off  auto on   off  on   auto auto on   auto on   off
cameras         on   off  auto off  auto off  on   auto off  off  on   auto on   auto auto off  on   auto on   off
"""


class Row(NamedTuple):
    """A command line that is run in a terminal and in a pipe, or in one of them where it takes long; those in braces
    are made by places.py."""

    arguments: str
    places: str = "terminal, pipe"
    status: int = 0
    until: str = ""       # Ctrl-C is pressed once this can be read
    says: str = ""        # what can be read in the end


# Options that many commands have: given to each that has one, in a terminal, and not in a pipe.
ON_A_TERMINAL: tuple[str, ...] = ("--verbose", "--overwrite")

COMMANDS = {
    "version": Row("--version", says="pagas-cl "),
    "help": Row("refine --help", says="--save-depth"),
    "a fault": Row("check {out}/nothing --debug", "pipe", status=1, says="Traceback"),
    "devices": Row("devices", says="chosen: "),
    "a device": Row("devices --device {device} --again --quiet", "pipe", says="chosen: "),
    "check a mesh": Row("check {scene} --mesh {mesh} --verbose", says="the cameras are right as they are"),
    "check depth maps": Row("check {scene} --depth-dir {maps} --depth-scale 1 --format cameras --outside --json",
                            "terminal", says='"ok": true'),
    "check photos": Row("check {network} --photos {network}/photos --quiet", "pipe"),
    "analyze from a mesh": Row("analyze {small} --mesh {small}/mesh_coarse.ply --views target --table --costs --device "
                               "{device} --outside --preset fast --effect exposure=auto", "terminal", says="eeded:"),
    "analyze from depth maps": Row("analyze {scene} --depth-dir {maps} --depth-scale 1 --no-costs --quiet --format "
                                   "cameras --set pyramid.steps=4 --json {out}/found.json", "pipe", says="Not needed:"),
    "analyze photos": Row("analyze {network} --photos {network}/photos --no-costs --preset fast", "terminal",
                          says="Not needed:"),
    "cameras over a mesh": Row("cameras {off_by_1} --mesh {mesh} --output {out}/cameras --device {device} --outside "
                               "--format cameras", says="cameras were off"),
    "cameras over depth maps": Row("cameras {off_by_1} --depth-dir {maps} --depth-scale 1 --unknowns pose focal "
                                   "--output {out}/cameras --devices all --quiet", "pipe", says="cameras were off"),
    "cameras by a cluster": Row("cameras {off_by_1} --mesh {mesh} --output {out}/cameras --scheduler {scheduler}",
                                "terminal", says="cameras were off"),
    "cameras on photos": Row("cameras {network} --photos {network}/photos --output {out}/cameras --quiet", "pipe",
                             says="/network/photos --output fine.ply"),
    "demo": Row("demo --output {out}/demo --width 96 --context 2 --preset fast --bar 3 --hard --device {device} "
                "--quiet", "terminal", says="mean depth error"),
    "evaluate a mesh": Row("evaluate {mesh} {true_mesh} --spacing 8 --threshold 4 --threshold 8 --max-distance 50 "
                           "--visible {visible} --ground {ground} --json {out}/figures.json", "terminal",
                           says="Chamfer distance"),
    "evaluate depth maps": Row("evaluate {maps} {true_maps} --quiet --scene {scene} --held-out held_out_0 --before "
                               "{maps} --depth-scale 1", "pipe", says="correlation of held-out photos"),
    "evaluate a mesh by photos": Row("evaluate {mesh} --scene {scene} --held-out held_out_0 --before {maps}",
                                     "terminal", says="Photos that took no part agree"),
    "evaluate by originals": Row("evaluate {network}/depth --scene {network} --photos {network}/photos --held-out "
                                 "000003", "pipe", says="correlation of held-out photos"),
    "script on a mesh": Row("script {script} {scene} --mesh {mesh} --output {out}/made.ply --save-script "
                            "{out}/history.mlx --device {device} --format cameras", "pipe"),
    "script on a project": Row("script {script} --project {project} --layer coarse --mlp-flavour meshlab --outside "
                               "--output {out}/made.mlp --quiet", "terminal"),
    "script without a scene": Row("script {script} --mesh {mesh} --photos {network}/photos --output {out}/made.ply",
                                  "pipe", status=2, says="--photos names the photos of SCENE"),
    "selftest": Row("selftest --device {device} --quiet", status=130, until=" ok", says="interrupted"),
    "tradeoff": Row("tradeoff {small} --depth-dir {small}/depth_initial --truth {small}/depth_true --views target "
                    "--budget 0.04 --repeats 1 --report {out}/page --depth-scale 1 --format cameras "
                    "--outside --device {device} --quiet", "pipe", says="plot and page: "),
    "tradeoff that is ended": Row("tradeoff {small} --mesh {small}/mesh_coarse.ply --held-out context_00 "
                                  "--sample 1", "terminal", status=130, until="measure",
                                  says="interrupted"),
    "tradeoff on photos": Row("tradeoff {network} --photos {network}/photos --sample 1 --budget 0.04", "pipe",
                              says="s per view"),
    # what MATRIX has not got of refine
    "what a scene holds": Row("refine {scene} --hold-out held_out_0 --output {out}/made.ply --preset fast", "pipe"),
    "some views": Row("refine {scene} --mesh {mesh} --keep-mesh --allow-loss --subdivide 3 --views target context_00 "
                      "--context 2 --format cameras --device {device} --set pyramid.steps=4 --effect noise=set "
                      "--output {out}/made.obj", "pipe"),
    "a network's": Row("refine {network} --photos {network}/photos --outside --align --preset fast --save-depth "
                       "{out}/maps", "pipe"),
    "devices side by side": Row("refine {scene} --depth-dir {maps} --depth-scale 1 --devices all --preset fast "
                                "--save-depth {out}/maps --report {out}/page", "terminal"),
    "a cluster": Row("refine {scene} --mesh {mesh} --scheduler {scheduler} --preset fast --save-depth {out}/maps "
                     "--output {out}/made.ply", "terminal"),
    "time per view": Row("refine {small} --depth-dir {small}/depth_initial --time-per-view 0.05 --set pyramid.steps=4 "
                         "--effect cameras=off agreement=off --save-depth {out}/maps", "terminal"),
    "a budget": Row("refine {small} --mesh {small}/mesh_coarse.ply --time-budget 0.0001 --set pyramid.steps=4 "
                    "--effect cameras=off agreement=off --output {out}/made.ply", "pipe", status=2,
                    says="a view takes at least"),
    "so many triangles": Row("refine {scene} --mesh {mesh} --preset fast --triangles 400 --color --output "
                             "{out}/made.ply", "pipe", says="the refined mesh: "),
    "a tolerance": Row("refine {scene} --mesh {mesh} --preset fast --tolerance 0.1 --output {out}/made.obj", "terminal",
                       says="the refined mesh: "),
    "pictures alone": Row("refine {scene} --mesh {mesh} --preset fast --report {out}/page", "terminal"),
}


def columns() -> list[dict[str, str]]:
    """The runs of MATRIX: a dict each, line -> word."""
    lines = [line.split() for line in MATRIX.strip().splitlines()]
    return [{line[0]: line[k] for line in lines} for k in range(1, len(lines[0]))]


@cache
def options_of(command: str) -> set[str]:
    """Every option of a command, as typer has it; none where there is no such command."""
    found = typer.main.get_command(build_app(command_names())).commands.get(command)
    return {word for option in found.params for word in (*option.opts, *option.secondary_opts)
            if word.startswith("--")} if found else set()
