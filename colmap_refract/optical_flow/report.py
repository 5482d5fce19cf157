"""What came of tracking, for people to read."""

from __future__ import annotations

from colmap_refract.optical_flow.tracking import FlowTracks

_WIDTH = 78


def lost_warning(tracks: FlowTracks) -> str:
    """A sentence for the user where most frames are lost; '' otherwise."""
    if 2 * len(tracks.lost) <= len(tracks.frames):
        return ""
    return (
        f"most frames could not be followed ({len(tracks.lost)} of {len(tracks.frames)}): if the camera moves, this is "
        "not the tool: use feature matching"
    )


def flow_report(tracks: FlowTracks) -> str:
    """A line per frame; lengths in pixels. Names longer than fit are cut at their beginning."""
    lines = [
        "=" * _WIDTH,
        "Tracks from the reference frame",
        "=" * _WIDTH,
        f"Reference:                        {tracks.reference}",
        f"Frames:                           {len(tracks.frames)}, {len(tracks.lost)} of them lost",
        f"Points:                           {len(tracks.keypoints[tracks.reference])} tracked to one frame at least",
        "",
        f"{'Frame':<32}{'tracked':>15}{'flow [px]':>11}{'back [px]':>11}{'alike':>9}",
        "-" * _WIDTH,
    ]
    for name, flow in tracks.frames.items():
        shown = name if len(name) < 32 else f"...{name[-28:]}"
        counts = f"{flow.num_tracks} / {flow.num_points}"
        figures = (
            f"{flow.length:>11.1f}{flow.error:>11.3f}{flow.correlation:>9.3f}" if flow.num_tracks else "       lost"
        )
        lines.append(f"{shown:<32}{counts:>15}{figures}")
    lines += [
        "",
        "flow: median length. back: median distance between a point and where its flow leads,",
        "forth and back, before it is refined. alike: median correlation of the squares at both ends.",
    ]
    if tracks.lost:
        lines += ["", "Lost, without keypoints in the database: " + ", ".join(tracks.lost)]
    return "\n".join(lines)
