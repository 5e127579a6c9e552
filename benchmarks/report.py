"""Writes docs/results.md: six tables of what matters most, each number from a record of docs/results."""

from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
TABLES: dict[str, tuple[tuple[str, str, str, str], ...]] = {
    "Drawing": (
        ("512 x 512, steps of 4 mm, one core", "march", "cpu_forward_4mm_ms", "ms"),
        ("the same on two cores", "march", "cpu_forward_4mm_wall_ms", "ms"),
        ("its gradients, one core", "march", "cpu_backward_4mm_ms", "ms"),
        ("times as fast as the reference, at 128 x 128", "march", "reference_over_cpu_128", ""),
        ("largest difference of a colour to the reference", "march", "rgb_error_max", ""),
        ("512 x 512 on a CUDA device", "march_cuda", "cuda_forward_512_ms", "ms"),
        ("512 x 512, steps of 1 mm", "march_cuda", "cuda_forward_1mm_ms", "ms"),
        ("16 humans at once, 512 x 512 each", "march_cuda", "cuda_forward_16_people_ms", "ms"),
        ("gradients of one", "march_cuda", "cuda_backward_4mm_ms", "ms"),
        ("F12 with the engine, 512 x 512", "engine", "engine_render_ms", "ms"),
    ),
    "In Blender": (
        ("a human of splats enters the scene", "splats", "add_human_seconds", "s"),
        ("a human in the .blend", "splats", "blend_mb_a_human", "MB"),
        ("splats follow a new pose", "splats", "splat_update_ms", "ms"),
        ("Cycles, 512 x 512, 16 samples", "splats", "splat_cycles_cpu_seconds", "CPU s"),
        ("splats against the exact picture, whole figure", "splats", "splat_psnr", "dB"),
        ("a picture of 1024 volumes in Cycles, 1 sample", "extension", "cycles_volumes_seconds", "s"),
        ("and of one merged volume", "extension", "cycles_merged_seconds", "s"),
        ("the backend's answer to a human in view, in a window", "first_sight", "in_view_seconds_window", "s"),
        ("longest pause of the window while it enters", "first_sight", "longest_stall_s", "s"),
        ("an opened .blend to its first picture", "first_sight", "open_to_visible_seconds", "s"),
        ("a motion of 1500 frames becomes keys", "extension", "amass_1500_seconds", "s"),
    ),
    "Humans from pictures": (
        ("8 views, people of the training", "encoder", "psnr_descended", "dB"),
        ("8 views, other people", "encoder", "psnr_descended_heldout", "dB"),
        ("the same, new views in new poses", "encoder", "psnr_descended_heldout_novel", "dB"),
        ("and their SSIM", "encoder", "ssim_descended_heldout_novel", ""),
        ("time", "encoder", "reconstruct_seconds_cpu", "s"),
        ("150 steps of descent more, held-out views", "refine", "refine_psnr_heldout_views_from_encoder", "dB"),
        ("one view, by the prior: eight unseen views", "from_pictures", "one_view_psnr", "dB"),
        ("one view: the view itself", "from_pictures", "one_view_seen_psnr", "dB"),
        ("16 frames of one view", "from_pictures", "frames_16_psnr", "dB"),
        ("a picture without a camera: its joints", "plain_pictures", "camera_error_px", "px"),
        ("a picture of a tilted camera: lean of the torso, median", "upright", "lean_error_median_deg", "degrees"),
        ("the same: one foot's sole above the other, median", "upright", "feet_plane_median_cm", "cm"),
        ("spoiled pictures whose fit says that it failed", "spoiled_pictures", "failed_fits_reported", ""),
        ("a person cut out by the body posed over it: overlap", "spoiled_pictures", "cutout_iou", ""),
    ),
    "Generated humans": (
        ("a human, 20 steps", "diffusion", "generate_seconds_cpu", "s"),
        ("memory", "diffusion", "peak_gb", "GB"),
        ("Frechet distance to meshes of other people", "diffusion", "distance_ours", ""),
        ("the same of other meshes, the floor", "diffusion", "distance_floor", ""),
        ("the same of training people after our codec", "diffusion", "distance_codec", ""),
        ("precision", "diffusion", "precision", ""),
        ("recall", "diffusion", "recall", ""),
        (
            "distance to the nearest training person, 1 is that of new people",
            "diffusion",
            "nearest_neighbour_ratio",
            "",
        ),
        ("least share of an attribute that was asked for and is there", "attribute_hits", "attribute_hit_min", ""),
        ("the paper's representation, 4 minutes of training: distance", "tables", "distance_ours", ""),
        ("one voxel grid, the same minutes", "tables", "distance_voxels", ""),
    ),
    "Training data": (
        ("people made a second", "captures", "people_per_second", ""),
        ("a view of 512 x 512 without Blender", "captures", "seconds_a_view_fast_512", "s"),
        ("the same view in Cycles", "captures", "seconds_a_view_cycles_512", "s"),
        ("IoU of their masks", "captures", "mask_iou_fast_vs_cycles", ""),
        ("PSNR between them", "captures", "psnr_fast_vs_cycles", "dB"),
        ("largest error of a joint in the picture", "captures", "joint_reprojection_px_max", "px"),
        ("views that a worker of the loader reads a second", "captures", "loader_views_per_second_512", ""),
        ("a human fitted to its mesh, whole body", "chain", "payload_body_psnr", "dB"),
        ("the same after the codec", "chain", "codec_body_psnr", "dB"),
        ("cosine of two fits from other cameras, of what components leave out", "chain", "fit_repeat_cosine_rest", ""),
    ),
    "Faithfulness and faults": (
        ("released network, largest difference to the paper's layers by hand", "faithful", "unet_error_max", ""),
        ("released encoder, the same", "faithful", "stage1_error_max", ""),
        ("FID, largest difference to another implementation", "faithful", "fid_equal_error", ""),
        ("hostile files and settings that were held", "faults", "attack_cases_held", ""),
        ("of", "faults", "attack_cases", ""),
    ),
}
"""Per table: what was measured, the record, its key, and the unit."""
TABLES_OF_THEIR_OWN = {
    "Drawing": ("march_table",),
    "Humans from pictures": ("encoder_table", "encoder_ablations_table"),
    "Generated humans": ("diffusion_table", "tables_table"),
}
HEAD = """# Results

Numbers by scripts of `benchmarks/`, which write the records that each table names: they hold every other number, the
versions and the commit. `benchmarks/report.py` makes this page from them. Figures of generated humans, of the codec and
of one view are those of the default checkpoint of their date; the included one is of 2026-11-30.
"""


def table(title: str) -> str:
    """A table, the records that it is from, and the tables that benchmarks wrote themselves."""
    records = {
        name: json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8")) for _, name, *_ in TABLES[title]
    }
    lines = [f"## {title}", "| | | |", "|---|---|---|"]
    for what, name, key, unit in TABLES[title]:
        lines.append(f"| {what} | {_written(records[name][key], unit)} | `{name}.{key}` |")
    sources = [
        f"[{name}](results/{name}.json): {record.get('device', '')}, {record.get('date', '')[:10]}"
        for name, record in records.items()
    ]
    longer = [f"[{name}](results/{name}.md)" for name in TABLES_OF_THEIR_OWN.get(title, ())]
    return "\n".join([*lines, "", "Records: " + "; ".join([*sources, *longer]) + "."])


def main() -> None:
    page = "\n".join([HEAD, "\n\n".join(map(table, TABLES)), ""])
    (ROOT / "docs" / "results.md").write_text(page, encoding="utf-8")


def _written(value: float | int | None, unit: str) -> str:
    if value is None:
        return "not measured"
    return f"{value:.4g} {unit}".strip() if isinstance(value, float) else f"{value} {unit}".strip()


if __name__ == "__main__":
    main()
