"""Cut the pictures of the home page for phones and of docs/reasons.md out of docs/images/demo.jpg.

``python benchmarks/figures/demo_crops.py``
"""

from pathlib import Path

from PIL import Image

IMAGES = Path(__file__).parents[2] / "docs" / "images"
# left, top, right, bottom in pixels of the whole picture
CROPS = {"demo_phone.jpg": (338, 150, 972, 400), "reasons.jpg": (220, 150, 1022, 402)}

if __name__ == "__main__":
    whole = Image.open(IMAGES / "demo.jpg")
    for name, box in CROPS.items():
        cut = whole.crop(box)
        # twice as large, so that the labels stay sharp where the page shows them larger
        cut.resize((2 * cut.width, 2 * cut.height), Image.Resampling.LANCZOS).save(IMAGES / name, quality=85)
        print(f"wrote {IMAGES / name}")
