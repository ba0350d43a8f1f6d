"""Page of two cells side by side: two pages of one server whose cameras and timelines are linked."""

from urllib.parse import quote

PATH = "/compare"
"""Path of the page; its query holds the links of both cells."""
OPEN_KEY = "review-open"
"""Key of the browser's storage under which the server writes an address to go to."""
PAIR = "pair"
"""Name in a cell's link of the pair that it belongs to."""


def compare_address(left: str, right: str) -> str:
    """Address of two cells by their links."""
    return f"{PATH}?left={quote(left, safe='')}&right={quote(right, safe='')}"


HTML = """<!doctype html><html><head><meta charset="utf-8"><title>Review: side by side</title><style>
html,body{margin:0;height:100%;background:#0a0c11;overflow:hidden}
main{display:flex;height:100%;gap:2px}
section{position:relative;flex:1;min-width:0}
iframe{width:100%;height:100%;border:0}
h1{position:absolute;left:14px;top:12px;margin:0;padding:5px 12px;pointer-events:none;border-radius:7px;
 font:600 14px/1.3 system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;color:#fff;background:rgba(13,16,23,.8);
 border:1px solid rgba(148,163,184,.25)}
</style></head><body><main></main><script>
const asked=new URLSearchParams(location.search),pair=Math.random().toString(36).slice(2),links={};
const title=link=>{const q=new URLSearchParams(link),k=q.get('corruption')||'clean',parts=[];
 if(q.get('methods'))parts.push(q.get('methods').split('|').map(decodeURIComponent).join(', '));
 if(q.get('cooperative')==='0')parts.push('ego alone');
 parts.push(k==='clean'?k:k.replaceAll('_',' ')+' '+(q.get('severity')||3));return parts.join(' \\u00b7 ');};
for(const side of ['left','right']){
 links[side]=asked.get(side)||'';
 const cell=document.createElement('section'),frame=document.createElement('iframe');
 frame.id=side;frame.src='/?'+[links[side],'fixedDpr=1','pair='+pair].filter(Boolean).join('&');
 const name=document.createElement('h1');name.textContent=title(links[side]);
 cell.append(frame,name);document.querySelector('main').append(cell);}
addEventListener('message',e=>{
 if(e.origin!==location.origin||typeof e.data?.review!=='string')return;
 for(const side in links){const frame=document.getElementById(side);
  if(frame.contentWindow!==e.source)continue;
  links[side]=e.data.review;frame.nextSibling.textContent=title(links[side]);
  history.replaceState(null,'',location.pathname+'?'+Object.entries(links).map(
   ([k,v])=>k+'='+encodeURIComponent(v)).join('&'));}});
document.getElementById('left').addEventListener('load',e=>e.target.contentWindow.focus());
</script></body></html>"""
