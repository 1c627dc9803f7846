"""A policy in motion, as a GIF: robots drawn from their geoms, with no need of OpenGL."""

import io

import numpy as np
import torch
from PIL import Image, ImageDraw

from diagnosis.common.atomic_files import write_whole
from diagnosis.report.outlines import outlines, view

SIZE, SCALE = (400, 300), 110  # of a frame in pixels, and pixels per metre
FINE = 3  # a frame is drawn so many times larger, and reduced: edges are smooth
MOST, EVERY = 500, 4  # steps shown, and steps per frame
GRID, FAR = 0.5, 6.0  # m: lines on the floor, and how far they reach
SKY, FLOOR, LINE, ROBOT, FIXED = "#f7f7f4", "#dcd9cf", "#8f8b80", "#1f5fa8", "#8f8b80"


def animate(policy, worlds, path):
    """A GIF of a policy acting in each of the worlds {title: BatchEnv of one}, side by side.

    Each world stops moving when its episode ends. Returns the returns reached within MOST steps, by
    title.
    """
    films = {title: film(policy, env, title) for title, env in worlds.items()}
    frames = []
    for parts in zip(*(pictures for pictures, _ in films.values())):
        frame = Image.new("RGB", (sum(p.width for p in parts), parts[0].height))
        for i, part in enumerate(parts):
            frame.paste(part, (i * part.width, 0))
        frames.append(frame.quantize(64))
    env, gif = next(iter(worlds.values())), io.BytesIO()
    milliseconds = max(20, int(1000 * env.dt * EVERY))
    look = {"save_all": True, "append_images": frames[1:], "loop": 0, "duration": milliseconds}
    frames[0].save(gif, "GIF", **look)
    write_whole(path, gif.getvalue())
    return {title: total for title, (_, total) in films.items()}


def film(policy, env, title):
    """(frames, return) of one episode, every EVERY-th of MOST steps; it stays as it ended."""
    obs, _ = env.reset(seed=0)
    box, model = env.single_action_space, env.model
    axes, towards = view(model, model.qpos0)
    frames, total, ended = [], 0.0, False
    for step in range(MOST):
        if step % EVERY == 0:
            if not ended:
                qpos = env.qpos[0].copy()
            follow = qpos[0] if env.task.skip_root_x else 0.0
            told = f"{title}: return {total:.0f}{', fallen' if ended else ''}"
            frames.append(draw(model, qpos, axes, towards, follow, told))
        if not ended:
            with torch.no_grad():
                action = policy.mean(torch.from_numpy(obs.astype(np.float32))).numpy()
            obs, reward, terminated, truncated, _ = env.step(np.clip(action, box.low, box.high))
            total, ended = total + float(reward[0]), bool(terminated[0] or truncated[0])
    return frames, total


def draw(model, qpos, axes, towards, x, title):
    """One frame of a pose (nq,), in the projection of outlines.view; the camera follows x."""
    image = Image.new("RGB", (SIZE[0] * FINE, SIZE[1] * FINE), SKY)
    pen = ImageDraw.Draw(image)
    middle, centre = axes @ [x, 0, 0], np.array([0.5, 0.82]) * SIZE

    def pixels(points):
        """(n, 2) on paper -> [(x, y), ...] on the image."""
        return [tuple(p) for p in FINE * (centre + (points - middle) * SCALE * [1, -1])]

    _floor(pen, axes, towards, x, pixels)
    for geom, outline, _ in outlines(model, qpos, axes, towards):
        color = FIXED if model.geom_bodyid[geom] == 0 else ROBOT
        if len(outline) > 2:
            pen.polygon(pixels(outline), fill=color, outline=SKY, width=FINE)
    image = image.resize(SIZE, Image.Resampling.LANCZOS)
    ImageDraw.Draw(image).text((8, 6), title, fill="#222222")
    return image


def _floor(pen, axes, towards, x, pixels):
    """The plane z = 0 and lines across it: seen edge-on, marks along it."""
    marks = GRID * np.arange(np.ceil((x - FAR) / GRID), (x + FAR) / GRID)
    ends = np.array([[(mark, y, 0) for y in (-FAR, FAR)] for mark in marks]) @ axes.T
    edge_on = abs(towards[2]) < 1e-6
    if edge_on:
        pen.rectangle((0, pixels(ends[0])[0][1], FINE * SIZE[0], FINE * SIZE[1]), fill=FLOOR)
    else:
        pen.polygon([*pixels(ends[:, 0]), *pixels(ends[::-1, 1])], fill=FLOOR)
    for line in map(pixels, ends):
        if edge_on:
            line[1] = line[0][0], line[0][1] + 6 * FINE
        pen.line(line, fill=LINE, width=FINE if edge_on else 1)
