# One image for the MLflow server, the Ray nodes and the client: the same Python and the same packages wherever an object is unpickled.
FROM python:3.11.13-slim-bookworm

ENV PYTHONUNBUFFERED=1 \
    PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    GIT_PYTHON_REFRESH=quiet \
    MLFLOW_DISABLE_TELEMETRY=true \
    RAY_USAGE_STATS_ENABLED=0

# Empty volumes take the owner of the folder they are mounted on, so these two must exist and belong to the user. The code does not:
# what runs as that user, jobs among it, cannot change it.
RUN useradd --uid 1000 --create-home dsffnet \
    && mkdir -p /app /data /artifacts \
    && chown dsffnet:dsffnet /data /artifacts

WORKDIR /app

# Dependencies first, from an empty shell of the project: a change of code does not install them again.
# TORCH_INDEX, if given, is one more package index; with PyTorch's CPU index the image is some gigabytes smaller (docs/cluster.md).
ARG TORCH_INDEX=""
COPY pyproject.toml constraints.txt LICENSE README.md ./
COPY deploy/requirements.txt deploy/
RUN mkdir datagen dsffnet training workflows && touch datagen/__init__.py dsffnet/__init__.py training/__init__.py workflows/__init__.py \
    && pip install --constraint constraints.txt ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} \
        --requirement deploy/requirements.txt --editable ".[s3]"

COPY . .
# Files of a checkout made under a strict umask are the owner's alone.
RUN chmod -R a+rX,go-w /app

USER dsffnet
