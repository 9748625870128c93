"""Puts the workflow into the wheel, where :data:`stereotruth.project.project.FILES` finds it.

In a clone, and in an editable installation, it stays at the top. The wheel's description is the
README without what only a clone has: its picture, and links to its files. ``STEREOTRUTH_KERNELS``
names a folder of compiled kernels that the wheel brings along (``make wheel``).
"""

import os
import re
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

FOLDERS = ("workflow", "config", "profiles")


class WithWorkflow(build_py):
    """Copies the Snakefile and the folders that belong to it into ``stereotruth/shipped``."""

    def run(self):
        """Build the package, and put the files of the workflow beside its modules."""
        super().run()
        if self.editable_mode:
            return
        shipped = Path(self.build_lib, "stereotruth", "shipped")
        shutil.rmtree(shipped, ignore_errors=True)
        shipped.mkdir(parents=True)
        shutil.copy("Snakefile", shipped)
        for folder in FOLDERS:
            ignored = shutil.ignore_patterns("__pycache__")
            shutil.copytree(folder, shipped / folder, ignore=ignored)
        if kernels := os.environ.get("STEREOTRUTH_KERNELS"):
            compiled = Path(self.build_lib, "stereotruth", "core", "compiled")
            shutil.copytree(kernels, compiled, dirs_exist_ok=True)


text = Path("README.md").read_text("utf-8")
text = re.sub(r"!\[[^\]]*\]\((?!https:)[^)]*\)\n+", "", text)
text = re.sub(r"\[([^\]]+)\]\((?!https:)[^)]*\)", r"\1", text)
setup(
    cmdclass={"build_py": WithWorkflow},
    long_description=text,
    long_description_content_type="text/markdown",
)
