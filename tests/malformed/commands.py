"""Models and command lines that must be refused."""

from arm import ARM

from malformed.case import MODEL, ONE, OUT


def models(add):
    """Models that do not load, or cannot be simulated."""

    def bad(name, says, data):
        add.case(name, says, "--model", "{dir}/bad.xml", *ONE, *OUT, bad_xml=data)

    no_model = "no such model", "--model"
    add.case("no such model", *no_model, "{dir}/absent.xml", *ONE, *OUT)
    add.case("model is a folder", *no_model, "{dir}", *ONE, *OUT)
    bad("model empty", "does not load", b"")
    bad("model not XML", "does not load", b"hello")
    bad("model cut off", "does not load", ARM.encode()[:400])
    engine = ARM.replace("<motor", "<engine", 1)
    bad("model with an unknown element", "does not load", engine.encode())
    gone = b'<mujoco><asset><mesh file="gone.stl"/></asset><worldbody/></mujoco>'
    bad("model without a mesh's file", "does not load", gone)
    bad("model without joints", "no joints", b"<mujoco><worldbody/></mujoco>")
    stiff = ARM.replace('damping="0.05"', 'stiffness="-1e9"').replace("implicitfast", "Euler")
    bad("model that blows up", "blows up", stiff.encode())
    for name, env in (
        ("no such environment", "NoSuchEnv-v9"),
        ("environment without MuJoCo", "CartPole-v1"),
    ):
        add.case(name, "does not load", "--env", env, *ONE, *OUT)


def command_lines(add):
    """Command lines that make no sense, or whose files do not."""
    file, more, held_out = "{dir}/run.csv", "{dir}/more.csv", "--held-out"
    both_told = "--env", *MODEL, "--env", "Hopper-v5"
    add.case("out is a file", "not a folder", *MODEL, *ONE, "--out", file)
    add.case("out below a file", "not a folder", *MODEL, *ONE, "--out", file + "/report")
    add.case("no arguments", "--help")
    add.case("no recordings", "recordings", *MODEL, *OUT)
    add.case("recordings named by nobody", "recordings", *MODEL, "--recordings", *OUT)
    add.case("neither model nor environment", "--model", *ONE, *OUT)
    add.case("both model and environment", *both_told, *ONE, *OUT)
    add.case("unknown option", "--colour", *MODEL, *ONE, *OUT, "--colour", "red")
    add.case("a recording twice", "twice", *MODEL, *ONE, file, *OUT)
    add.case("held out and fitted", "held out", *MODEL, *ONE, held_out, file, *OUT)
    add.case("held out is empty", "empty", *MODEL, *ONE, held_out, more, *OUT, more_csv=b"")
    cut = add.text[:-20]
    add.case("second recording is bad", "more.csv", *MODEL, *ONE, more, *OUT, more_csv=cut)
