"""Scores the image pairs with the libraries that are installed and adds what they say to ``vectors.json``.

    python tests/metrics/conformance/make_vectors.py [folder with alexnet_features.pth]

Run once in an environment with each version wanted (torchmetrics before 1.4.2 and a recent one). Values are those of
float64 inputs where a library takes them. The weights are needed for LPIPS alone.
"""

import importlib
import importlib.metadata
import json
import sys
from pathlib import Path

import numpy as np
import torch
from pairs import fingerprint, image_pairs

FILE = Path(__file__).with_name("vectors.json")


def tensors(pair, dtype=torch.float64):
    return [torch.tensor(a).permute(2, 0, 1)[None].to(dtype) / 255 for a in pair]


def skimage_scores(pair):
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return {
        "psnr": peak_signal_noise_ratio(pair[1], pair[0], data_range=255),
        "ssim_default": structural_similarity(*pair, channel_axis=2, data_range=255),
        "ssim_gaussian": structural_similarity(*pair, channel_axis=2, data_range=255, **gaussian),
    }


def torchmetrics_scores(pair):
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    x, y = tensors(pair)
    return {
        "psnr": float(peak_signal_noise_ratio(x, y, data_range=1.0)),
        "ssim": float(structural_similarity_index_measure(x, y, data_range=1.0)),
    }


def piq_scores(pair):
    import piq

    x, y = tensors(pair)
    return {
        "psnr": float(piq.psnr(x, y)),
        "ssim_default": float(piq.ssim(x, y)),
        "ssim_full_size": float(piq.ssim(x, y, downsample=False)),
    }


def pytorch_msssim_scores(pair):
    from pytorch_msssim import ssim

    return {"ssim": float(ssim(*tensors(pair), data_range=1.0))}


def lpips_scores(pair):
    import lpips

    if len(sys.argv) < 2:
        return {}
    state = torch.load(Path(sys.argv[1]) / "alexnet_features.pth", weights_only=True)
    metric = lpips.LPIPS(net="alex", pnet_rand=True, verbose=False)
    own = metric.net.state_dict()
    metric.net.load_state_dict({k: state["features." + k.split(".", 1)[1]] for k in own})
    x, y = tensors(pair, torch.float32)
    with torch.no_grad():
        return {"alex": float(metric(2 * x - 1, 2 * y - 1)), "alex_unscaled": float(metric(x, y))}


def flip_evaluator_scores(pair):
    import flip_evaluator

    image, truth = (np.ascontiguousarray(a, dtype=np.float32) / 255 for a in pair)
    _, mean, parameters = flip_evaluator.evaluate(truth, image, "LDR", inputsRGB=True, applyMagma=False)
    return {"mean": float(mean), "pixels_per_degree": float(parameters["ppd"])}


LIBRARIES = {
    "scikit-image": skimage_scores,
    "torchmetrics": torchmetrics_scores,
    "piq": piq_scores,
    "pytorch-msssim": pytorch_msssim_scores,
    "lpips": lpips_scores,
    "flip-evaluator": flip_evaluator_scores,
}


def main():
    vectors = json.loads(FILE.read_text()) if FILE.exists() else {"pairs": {}, "scores": {}}
    pairs = image_pairs()
    vectors["pairs"] = {name: fingerprint(pair) for name, pair in pairs.items()}
    for library, scores in LIBRARIES.items():
        try:
            found = {name: scores(pair) for name, pair in pairs.items()}
        except ImportError as error:
            print(f"{library}: {error}")
            continue
        vectors["scores"][f"{library} {importlib.metadata.version(library)}"] = found
        print(library, found)
    FILE.write_text(json.dumps(vectors, indent=1) + "\n")


if __name__ == "__main__":
    main()
