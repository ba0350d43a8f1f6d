"""Up to four cells side by side that show one moment from one camera; what makes them differ stays each one's own.

Cells are pages of one server in the frames of another page, `HTML`.
"""

import threading
from collections import deque
from dataclasses import fields, replace
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

from dsrc.review.model import ReviewModel
from dsrc.review.page.cameras import CameraPose
from dsrc.review.page.page import Page
from dsrc.review.state import ReviewState
from sensors.corruptions import CLEAN, CORRUPTIONS

PATH = "/compare"
"""Path of the page; its query holds the links of both cells."""
PAIR = "pair"
"""Name in a cell's link of the pair that it belongs to, with its place after a point."""

CELL = "cell"
"""Name of the link of a cell in the address of cells."""
MOST = 4
"""Most cells of a page."""
_OWN = {
    *"corruption severity family parameters corrupted_agents methods cooperative detection versus".split(),
    # Whose errors are listed, and whether any can be broken or fixed, follows from these.
    *("error_method", "listed"),
}
_SHARED = tuple(field.name for field in fields(ReviewState) if field.name not in _OWN)
_REMEMBERED = 30


class CellPair:
    """Cells that follow each other; threads share it.

    Attributes:
        cells: in the order in which they came.
    """

    def __init__(self) -> None:
        self.cells: list[Page] = []
        # What a cell was given and has not drawn yet, and what the last user set in any cell.
        self._given: dict[int, deque[tuple[Any, ...]]] = {}
        self._newest: tuple[Any, ...] | None = None
        self._shares = _SHARED
        self._lock = threading.Lock()

    def add(self, cell: Page) -> None:
        """Add a cell, which takes what it shares from one that is there."""
        with self._lock:
            others = list(self.cells)
            self.cells.append(cell)
            cell.cells = self.cells
            self._given[id(cell)] = deque(maxlen=_REMEMBERED)
            before = others[0].state.drive if others else cell.state.drive
            if before != cell.state.drive and cell.state.drive in cell.model.twins(before):
                # One episode with other eyes or another driver in each cell: they run in step.
                self._shares = tuple(name for name in _SHARED if name != "drive")
            if not others or self._shares != _SHARED:
                self._newest = self._shared((others or [cell])[0].state)
        for other in others[:1]:
            self._give(cell, other.state)

    def remove(self, cell: Page) -> None:
        """Remove a cell."""
        with self._lock:
            self.cells.remove(cell)
            self._given.pop(id(cell), None)

    def state_changed(self, cell: Page, state: ReviewState) -> None:
        """Take a state of a cell to the others, unless it has it from them or they have it already."""
        with self._lock:
            shared, given = self._shared(state), self._given.get(id(cell))
            if given is None:
                # It takes what the others have when it is added.
                return
            if shared == self._newest:
                given.clear()
                return
            if shared in given:
                # It came from another cell, which is further by now. A later return to it is the user's.
                while given.popleft() != shared:
                    pass
                return
            given.clear()
            self._newest = shared
            others = [one for one in self.cells if one is not cell]
        for other in others:
            self._give(other, state)

    def camera_moved(self, cell: Page, pose: CameraPose) -> None:
        """Take the camera of a cell, which its user moved, to the others, in the event loop."""
        with self._lock:
            others = [one for one in self.cells if one is not cell]
        for other in others:
            other.camera.set(pose, own=False)

    def _shared(self, state: ReviewState) -> tuple[Any, ...]:
        return tuple(getattr(state, name) for name in self._shares)

    def _give(self, cell: Page, state: ReviewState) -> None:
        if "drive" not in self._shares:
            # An episode that has ended waits at its last step.
            state = replace(state, frame=min(state.frame, len(cell.model.sources[cell.state.drive]) - 1))
        with self._lock:
            if (given := self._given.get(id(cell))) is None:
                return
            given.append(self._shared(state))
        wanted = {name: getattr(state, name) for name in self._shares}
        if "drive" in wanted and state.drive != cell.state.drive:
            # Another drive starts anew; the rest follows.
            cell.update(drive=state.drive)
        cell.update(**{name: value for name, value in wanted.items() if value != getattr(cell.state, name)})


def cells_of(model: ReviewModel, state: ReviewState, last_corruption: str = "") -> list[ReviewState]:
    """Two to four states that are compared side by side.

    Methods where several are shown, clean and corrupted sweeps, or two methods on both; the same episode with other
    eyes or another driver; else the drive's first two methods, or clean sweeps and the last corruption.

    Args:
        last_corruption: kind of the last corruption, "" for none.
    """
    methods, clean = model.methods(state.drive), replace(state, corruption=CLEAN, parameters=())
    if len(state.methods) > 1 or state.corruption != CLEAN:
        sweeps = [state] if state.corruption == CLEAN else [clean, state]
        shown = [(name,) for name in state.methods] if len(state.methods) > 1 else [state.methods]
        return [replace(one, methods=own) for one in sweeps for own in shown[: MOST // len(sweeps)]]
    if twins := model.twins(state.drive):
        return [state, *(replace(state, drive=one) for one in sorted(twins, key=lambda one: one < state.drive))][:MOST]
    if len(methods) > 1:
        shown_first = model.method(state)
        other = next(name for name in methods if name != shown_first)
        return [replace(state, methods=(name,)) for name in (shown_first, other)]
    return [state, replace(state, corruption=last_corruption or next(iter(CORRUPTIONS)))]


def compare_address(*links: str) -> str:
    """Address of cells by their links."""
    return f"{PATH}?{urlencode([(CELL, link) for link in links], quote_via=quote, safe='')}"


def links_of(query: str) -> list[str]:
    """Links of the cells of an address or its query, at most `MOST`; the query itself where it is of no cells."""
    query = query.partition("?")[2] or query
    return [link for name, link in parse_qsl(query, keep_blank_values=True) if name == CELL][:MOST] or [query]


HTML = """<!doctype html><html><head><meta charset="utf-8"><title>Review: side by side</title><style>
html,body{margin:0;height:100%;background:#0a0c11;overflow:hidden}
main{display:grid;height:100%;gap:2px;grid-template-columns:1fr 1fr;grid-auto-rows:1fr}
section{position:relative;min-width:0;min-height:0}
iframe{width:100%;height:100%;border:0}
h1{position:absolute;left:14px;top:12px;margin:0;padding:5px 12px;pointer-events:none;border-radius:7px;
 font:600 14px/1.3 system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;color:#fff;background:rgba(13,16,23,.8);
 border:1px solid rgba(148,163,184,.25)}
</style></head><body><main></main><script>
const links=new URLSearchParams(location.search).getAll('__CELL__').slice(0,__MOST__);
const pair=Math.random().toString(36).slice(2);
const drive=link=>new URLSearchParams(link).get('drive')||'0';
const title=link=>{const q=new URLSearchParams(link),k=q.get('corruption')||'clean',parts=[];
 const own=links.some(one=>drive(one)!==drive(links[0])),name=drive(link);
 if(own)parts.push(/^\\d+$/.test(name)?'drive '+name:name);
 if(q.get('methods'))parts.push(q.get('methods').split('|').map(decodeURIComponent).join(', '));
 if(q.get('cooperative')==='0')parts.push('ego alone');
 if(!own||k!=='clean')parts.push(k==='clean'||k.includes(':')?k:k.replaceAll('_',' ')+' '+(q.get('severity')||3));
 return parts.join(' \\u00b7 ');};
const frames=links.map((link,number)=>{
 const cell=document.createElement('section'),frame=document.createElement('iframe');
 frame.id='cell'+number;frame.src='./?'+[link,'fixedDpr=1','pair='+pair+'.'+number].filter(Boolean).join('&');
 const name=document.createElement('h1');name.textContent=title(link);
 cell.append(frame,name);document.querySelector('main').append(cell);return frame;});
addEventListener('message',e=>{
 const number=frames.findIndex(frame=>frame.contentWindow===e.source);
 if(e.origin!==location.origin||typeof e.data?.review!=='string'||number<0)return;
 links[number]=e.data.review;frames[number].nextSibling.textContent=title(links[number]);
 history.replaceState(null,'',location.pathname+'?'+links.map(
  link=>'__CELL__='+encodeURIComponent(link)).join('&'));});
frames[0]?.addEventListener('load',e=>e.target.contentWindow.focus());
</script></body></html>""".replace("__CELL__", CELL).replace("__MOST__", str(MOST))
